"""Young's moduli of structures from a recorded press and landmarks: from a record to a result.

A force sensor has an offset (tare) on each channel, and its stamps may be late by a little more
than is known. Both are unknowns beside the moduli, in which the measurements are linear; poses
without contact, at which no model is needed, tell the offset.

A CSV of landmarks has the columns name, time, x, y, z: seconds since the first pose of the
recording, and metres in frame ``patient`` or with a unit. A row without a time says where the point
is at rest.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import StiffnessError
from us_sim.settings.quantity import Quantity
from us_sim.settings.text_files import read_text
from us_sim.tissue.identification.fit import (
    FARTHEST,
    FitResult,
    Identifiability,
    assess_identifiability,
    fit,
)
from us_sim.tissue.identification.press_model import (
    CarriedPoints,
    MaterialsFor,
    PredictedPress,
    PressedTissue,
    PressModel,
)
from us_sim.tissue.identification.press_record import (
    CHANNELS,
    ChosenPoses,
    PressRecord,
    choose_poses,
)
from us_sim.tissue.identification.settings import StiffnessSettings
from us_sim.tissue.mesh.embedding import locate
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
from us_sim.tissue.model import TissueModel

# Kinds of measurements, each with a noise of its own: N, N m, m.
GROUPS = ("force", "torque", "landmark")


@dataclass(frozen=True, eq=False)
class LandmarkSightings:
    """Places of landmarks that were seen."""

    places: NDArray[np.float64]  # (S, 3) m, frame patient
    poses: NDArray[np.intp]  # (S,) number among the chosen poses that press
    times: NDArray[np.float64]  # (S,) s


@dataclass(frozen=True, eq=False)
class Observations:
    """n measured numbers; those with a model come first."""

    values: NDArray[np.float64]  # (n,) N, N m or m
    groups: NDArray[np.intp]  # (n,) into GROUPS
    times: NDArray[np.float64]  # (n,) s
    depths: NDArray[np.float64]  # (n,) m, of the probe in the undeformed tissue; 0 without contact
    nuisance: NDArray[np.float64]  # (n, Q), how they change with each unknown that is no modulus
    nuisance_names: tuple[str, ...]  # Q
    channels: NDArray[np.intp]  # of the wrench, those used

    def modelled(self, felt: PredictedPress) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(n,) modelled values of these, and (n, P) their slopes by the logarithms of moduli."""
        count = felt.slopes.shape[2]
        values = [felt.wrenches[:, self.channels].ravel(), felt.places.ravel()]
        slopes = [
            felt.slopes[:, self.channels].reshape(-1, count),
            felt.place_slopes.reshape(-1, count),
        ]
        without = len(self.values) - sum(map(len, values))
        values.append(np.zeros(without))
        slopes.append(np.zeros((without, count)))
        return np.concatenate(values), np.concatenate(slopes)


def observations_of(
    record: PressRecord,
    chosen: ChosenPoses,
    seen: LandmarkSightings | None = None,
    *,
    late: bool = False,
) -> Observations:
    """The measurements at chosen poses.

    Args:
        late: whether the wrenches' stamps may be late by a little more.
    """
    channels = np.flatnonzero(record.channels)
    count, free, width = len(chosen.pressed), len(chosen.free), len(channels)
    places = np.zeros((0, 3)) if seen is None else seen.places
    at_landmarks = np.zeros(0, np.intp) if seen is None else seen.poses
    poses = np.concatenate([chosen.pressed, chosen.free])
    felt = record.wrenches[poses][:, channels]
    names = [f"offset of {CHANNELS[channel]}" for channel in channels] + ["delay"] * late
    offsets = np.tile(np.eye(width), (count + free, 1))
    if late:
        offsets = np.column_stack([offsets, record.rates[poses][:, channels].ravel()])
    split, seen_count = count * width, places.size
    kinds = np.tile(np.where(channels < 3, 0, 1), count + free)
    depths = np.maximum(-chosen.clearance, 0.0)

    def joined(of_wrenches: NDArray, of_landmarks: NDArray) -> NDArray:
        return np.concatenate([of_wrenches[:split], of_landmarks, of_wrenches[split:]])

    return Observations(
        values=joined(felt.ravel(), places.ravel()),
        groups=joined(kinds, np.full(seen_count, 2)),
        times=joined(
            np.repeat(record.times[poses], width),
            np.repeat(np.zeros(0) if seen is None else seen.times, 3),
        ),
        depths=joined(
            np.repeat(depths[poses], width), np.repeat(depths[chosen.pressed][at_landmarks], 3)
        ),
        nuisance=joined(offsets, np.zeros((seen_count, offsets.shape[1]))),
        nuisance_names=tuple(names),
        channels=channels,
    )


_COLUMNS = ("name", "time", "x", "y", "z")
_TIME, _LENGTH = Quantity("time", -1e6, 1e6), Quantity("length", -10.0, 10.0)
_OUTSIDE = 1e-3  # m, that a point may lie outside the mesh


@dataclass(frozen=True, eq=False)
class Landmarks:
    """L points at rest, and S sightings of them."""

    names: tuple[str, ...]  # L
    rest: NDArray[np.float64]  # (L, 3) m, frame patient
    which: NDArray[np.intp]  # (S,) of the points
    times: NDArray[np.float64]  # (S,) s, since the first pose of the recording
    places: NDArray[np.float64]  # (S, 3) m, frame patient

    def at(
        self, record: PressRecord, chosen: ChosenPoses, mesh: TetrahedralMesh, tolerance: float
    ) -> tuple[ChosenPoses, LandmarkSightings, CarriedPoints]:
        """The sightings, with their poses added to the chosen ones.

        Raises:
            StiffnessError: there is no pose at the time of one, or a point is outside the mesh.
        """
        located = locate(mesh, self.rest)
        for name, outside in zip(self.names, located.outside, strict=True):
            if outside > _OUTSIDE:
                raise StiffnessError(
                    f"landmark {name} lies {1e3 * outside:.1f} mm outside the tissue's mesh: give "
                    f"places at rest in frame patient"
                )
        nearest = np.abs(record.times[:, None] - self.times).argmin(axis=0)
        for name, time, pose in zip(self.which, self.times, nearest, strict=True):
            if abs(record.times[pose] - time) > tolerance:
                raise StiffnessError(
                    f"landmark {self.names[name]} was seen at {time:g} s, and no pose with a "
                    f"wrench is within {1e3 * tolerance:g} ms of that"
                )
        pressing = chosen.clearance[nearest] < 0.0
        nearest = nearest[pressing]
        if len(nearest) == 0:
            raise StiffnessError("no landmark was seen while the probe pressed the tissue")
        pressed = np.union1d(chosen.pressed, nearest)
        poses, which = np.searchsorted(pressed, nearest), self.which[pressing]
        seen = LandmarkSightings(self.places[pressing], poses, self.times[pressing])
        points = CarriedPoints(
            poses,
            self.rest[which],
            mesh.tetrahedra[located.tetrahedra[which]],
            located.weights[which],
        )
        return replace(chosen, pressed=pressed), seen, points


def read_landmarks(file: str | Path) -> Landmarks:
    """The landmarks of a CSV.

    Raises:
        StiffnessError: it cannot be read, a column is missing, a cell is no such quantity, or a
            point has no place at rest, or is never seen.
    """
    file = Path(file)
    rest: dict[str, list[float]] = {}
    sights: list[tuple[str, float, list[float]]] = []
    try:
        reader = csv.DictReader(io.StringIO(read_text(file, "utf-8-sig")), skipinitialspace=True)
        reader.fieldnames = [name.strip() for name in reader.fieldnames or ()]
        missing = [name for name in _COLUMNS if name not in reader.fieldnames]
        if missing:
            raise StiffnessError(
                f"{file}: has no column {missing[0]}; its first line must be {','.join(_COLUMNS)}"
            )
        for row in reader:
            name, time = (row["name"] or "").strip(), (row["time"] or "").strip()
            try:
                place = [_LENGTH.parse((row[axis] or "").strip()) for axis in "xyz"]
                when = _TIME.parse(time) if time else None
            except ValueError as error:
                raise StiffnessError(f"{file}: line {reader.line_num}: {error}") from error
            if when is not None:
                sights.append((name, when, place))
            elif name in rest:
                raise StiffnessError(f"{file}: line {reader.line_num}: {name} is at rest twice")
            else:
                rest[name] = place
    except OSError as error:
        raise StiffnessError(f"{file}: cannot be read: {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise StiffnessError(f"{file}: is no CSV: {error}") from error
    for name, when, _ in sights:
        if name not in rest:
            raise StiffnessError(
                f"{file}: {name} is seen at {when:g} s, but no row without a time says where it is "
                f"at rest"
            )
    if not sights:
        raise StiffnessError(f"{file}: no row has a time, so that nothing was seen")
    names = tuple(rest)
    return Landmarks(
        names,
        np.array([rest[name] for name in names]),
        np.array([names.index(name) for name, _, _ in sights], dtype=np.intp),
        np.array([when for _, when, _ in sights]),
        np.array([place for _, _, place in sights]),
    )


_UNITS = (("force", 1.0, "N"), ("torque", 1.0, "N m"), ("landmarks", 1e3, "mm"))


def undetermined(
    names: Sequence[str],
    known: Identifiability,
    observed: Observations,
    fitted: FitResult,
    settings: StiffnessSettings,
    stiffenings: Mapping[str, str],
) -> str:
    """Reasons why a press does not determine moduli, and remedies, in a sentence."""
    reasons, unknown = [], [p for p in range(len(names)) if not known.determined[p]]
    for p in unknown:
        if not known.felt[p]:
            reasons.append(f"{names[p]} hardly matters: {_effect(p, observed, fitted, settings)}")
        elif known.like[p]:
            others = " and ".join(names[other] for other in known.like[p][:3])
            reasons.append(f"{names[p]} cannot be told from {others}, which act alike")
        else:
            factor = np.exp(min(known.half_widths[p], 50.0))
            reasons.append(f"{names[p]} is known to a factor of {factor:.3g} only")
    those = [names[p] for p in unknown if names[p] not in stiffenings]
    remedies = [f"fix what it does not with --keep {' '.join(those)}"] * bool(those)
    for name in (names[p] for p in unknown if names[p] in stiffenings):
        remedies.append(f"leave {stiffenings[name]} out of --stiffening")
    fine = [name for name, fine in zip(names, known.determined, strict=True) if fine]
    rest = f"; it does determine {', '.join(fine)}" if fine else ""
    return (
        f"this press does not determine {', '.join(names[p] for p in unknown)}: "
        f"{'; '.join(reasons)}{rest}; {', '.join(remedies)}, or press deeper, from other sides, "
        f"or nearer to it"
    )


def _effect(p: int, observed: Observations, fitted: FitResult, settings: StiffnessSettings) -> str:
    """Largest change by a stiffer structure beside the noise, in a sentence."""
    best, text = -1.0, ""
    for group, (name, scale, unit) in enumerate(_UNITS):
        its = observed.groups == group
        if not its.any():
            continue
        change = float(np.abs(fitted.jacobian[its, p]).max()) * np.log(settings.widest)
        noise = float(fitted.noise[its][0])
        if change / noise > best:
            best = change / noise
            text = (
                f"{settings.widest:g} times as stiff it would change the {name} by "
                f"{scale * change:.2g} {unit} at most, and their scatter is {scale * noise:.2g} "
                f"{unit}"
            )
    return text


Progress = Callable[[float, str], None]


@dataclass(frozen=True, eq=False)
class Tissue:
    """The pressed tissue and probe, and how its materials follow from moduli."""

    model: TissueModel
    materials_for: MaterialsFor
    moduli: Mapping[str, float]  # Pa, of all structures, with which a fit begins
    # Names of stiffenings that are fitted, among the moduli though without unit, and of whom
    stiffenings: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Interval:
    """Confidence interval of a modulus, Pa."""

    lower: float
    upper: float
    factor: float  # by which both ends are away from the modulus
    weight: float  # part of the press' force that the modulus answers for: d log force / d log E


@dataclass(frozen=True, eq=False)
class StiffnessFit:
    """Moduli, how well they are known, and how well they explain the press."""

    moduli: Mapping[str, float]  # Pa, of all structures
    intervals: Mapping[str, Interval]  # of those that were fitted
    confidence: float
    observations: Observations
    fitted: FitResult
    depths: NDArray[np.float64]  # (K,) m, of the poses that press
    remarks: tuple[str, ...]
    stiffenings: Mapping[str, str]  # as of the `Tissue`

    @property
    def constants(self) -> dict[str, dict[str, float]]:
        """Fitted constants of materials, by structure."""
        made: dict[str, dict[str, float]] = {}
        for name in self.intervals:
            key = "stiffening" if name in self.stiffenings else "young_modulus"
            made.setdefault(self.stiffenings.get(name, name), {})[key] = self.moduli[name]
        return made

    @property
    def modelled(self) -> NDArray[np.float64]:
        """(n,) modelled values of the measurements, offsets included."""
        return self.observations.values - self.fitted.residual

    def scatter(self, kind: str) -> float | None:
        """RMS of the residuals of forces (N), torques (N m) or landmarks (m); None without."""
        its = self.observations.groups == GROUPS.index(kind)
        return float(np.sqrt((self.fitted.residual[its] ** 2).mean())) if its.any() else None


def fit_stiffness(
    tissue: Tissue,
    record: PressRecord,
    settings: StiffnessSettings | None = None,
    landmarks: Landmarks | None = None,
    *,
    chosen: ChosenPoses | None = None,
    progress: Progress | None = None,
) -> StiffnessFit:
    """The moduli that explain a press best.

    Args:
        landmarks: points that were seen meanwhile.
        chosen: poses; by default `choose_poses` does.
        progress: told how far a step of the fit is, and which it is.

    Raises:
        StiffnessError: the press does not determine the moduli, or is not one of this tissue.
        SolverError: the tissue cannot be solved.
    """
    settings = settings or StiffnessSettings()
    names = _fitted_names(tissue, record, settings)
    if chosen is None:
        chosen = choose_poses(record, PressedTissue(tissue.model).clearance, settings.poses)
    seen, points = None, None
    if landmarks is not None:
        chosen, seen, points = landmarks.at(record, chosen, tissue.model.mesh, settings.tolerance)
    observed = observations_of(
        record, chosen, seen, late=settings.time_offset is None and not record.same_stamps
    )
    press = PressModel(
        tissue.model, tissue.materials_for, names, [record.pose(k) for k in chosen.pressed], points
    )
    start = np.log([tissue.moduli[name] for name in names])
    step = ""

    def model(at: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        moduli = {**tissue.moduli, **dict(zip(names, np.exp(at).tolist(), strict=True))}
        show = None if progress is None else lambda done, _: progress(done, step)
        values, slopes = observed.modelled(press.predict(moduli, show))
        if at is start:
            _require_same_sign(observed, values)
        return values, slopes

    def told(number: float, text: str) -> None:
        nonlocal step
        step = f"step {number + 1:.0f}, {text}"

    fitted = fit(model, observed.values, observed.groups, observed.nuisance, start, told)
    if progress is not None:
        progress(1.0, step)
    return _result(tissue, names, observed, fitted, chosen, settings)


def _fitted_names(tissue: Tissue, record: PressRecord, settings: StiffnessSettings) -> list[str]:
    for name in settings.keep:
        if name not in tissue.moduli:
            raise StiffnessError(
                f"--keep {name}: there is no such structure; there are {', '.join(tissue.moduli)}"
            )
    names = [name for name in tissue.moduli if name not in settings.keep]
    if not names:
        raise StiffnessError("--keep names every structure, so that there is nothing to fit")
    if not record.channels.any() and len(names) == len(tissue.moduli):
        raise StiffnessError(
            "without forces only ratios of moduli can be determined: record the wrench on the "
            f"probe, or keep a modulus that is known, such as --keep {names[0]}"
        )
    return names


def _require_same_sign(observed: Observations, values: NDArray[np.float64]) -> None:
    """Refuse forces on the tissue in place of those on the probe."""
    for place, channel in enumerate(observed.channels):
        if channel == 2:
            its = observed.nuisance[:, place] > 0
            measured = observed.values[its] - observed.values[its].mean()
            if measured @ (values[its] - values[its].mean()) < 0.0:
                raise StiffnessError(
                    "the wrench points the other way: the force on the probe falls below zero "
                    "along its z when it is pressed in, and here it rises; turn the sensor's sign"
                )


def _result(
    tissue: Tissue,
    names: list[str],
    observed: Observations,
    fitted: FitResult,
    chosen: ChosenPoses,
    settings: StiffnessSettings,
) -> StiffnessFit:
    known = assess_identifiability(
        fitted,
        observed.nuisance,
        observed.times,
        observed.depths,
        settings.widest,
        settings.confidence,
    )
    if not known.determined.all():
        raise StiffnessError(
            undetermined(names, known, observed, fitted, settings, tissue.stiffenings)
        )
    if fitted.bounded.any():
        first = names[int(np.argmax(fitted.bounded))]
        kept = f"keep it with --keep {first}"
        if first in tissue.stiffenings:
            kept = f"leave {tissue.stiffenings[first]} out of --stiffening"
        raise StiffnessError(
            f"{first} runs to {FARTHEST:g} times what the scene says, or that part "
            f"of it: the press contradicts the scene; check the registration, the sensor's "
            f"units and what else is soft, or {kept}"
        )
    moduli = np.exp(fitted.log_moduli)
    factors = np.exp(known.half_widths)
    weights = _weights(observed, fitted)
    intervals = {
        name: Interval(
            float(modulus / factor), float(modulus * factor), float(factor), float(weight)
        )
        for name, modulus, factor, weight in zip(names, moduli, factors, weights, strict=True)
    }
    return StiffnessFit(
        moduli={**tissue.moduli, **dict(zip(names, moduli.tolist(), strict=True))},
        intervals=intervals,
        confidence=settings.confidence,
        observations=observed,
        fitted=fitted,
        depths=np.maximum(-chosen.clearance[chosen.pressed], 0.0),
        remarks=_remarks(chosen, observed, fitted),
        stiffenings=tissue.stiffenings,
    )


def _weights(observed: Observations, fitted: FitResult) -> NDArray[np.float64]:
    """(P,) share of each modulus in the forces, or, without any, in all measurements."""
    model = observed.values - fitted.residual - observed.nuisance @ fitted.nuisance
    its = observed.groups == (0 if (observed.groups == 0).any() else observed.groups.min())
    size = float(model[its] @ model[its]) or 1.0
    return np.asarray(fitted.jacobian[its].T @ model[its] / size)


def _remarks(chosen: ChosenPoses, observed: Observations, fitted: FitResult) -> tuple[str, ...]:
    remarks = []
    if len(observed.channels) and len(chosen.free) == 0:
        remarks.append(
            "the probe touches the tissue all the time, so that the sensor's offset is fitted from "
            "the press alone: record it in the air, too"
        )
    missing = [GROUPS[k] for k in (0, 1) if not (observed.groups == k).any()]
    if missing:
        remarks.append(f"no {' and no '.join(missing)} was measured")
    if "delay" in observed.nuisance_names:
        late = fitted.nuisance[observed.nuisance_names.index("delay")]
        remarks.append(f"the wrenches were {-1e3 * late:+.1f} ms later than was found beforehand")
    return tuple(remarks)
