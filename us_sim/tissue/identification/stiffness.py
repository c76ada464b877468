"""Young's moduli of structures from a recorded press: the whole way from a record to a result.

The tissue that presses in this example made the forces too, so that they say what it is made of:

>>> import numpy as np
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tissue.elasticity.material import Material
>>> from us_sim.tissue.elasticity.materials import uniform_material
>>> from us_sim.tissue.identification.press_model import PressModel
>>> from us_sim.tissue.identification.press_record import paired
>>> from us_sim.tissue.identification.settings import StiffnessSettings
>>> from us_sim.tissue.identification.stiffness import Tissue, fit_stiffness
>>> from us_sim.tissue.model import TissueModel
>>> model = TissueModel.block(nodes=(5, 5, 5))
>>> tissue = Tissue(model, lambda e: uniform_material(model.mesh, Material(e["gel"])), {"gel": 4e3})
>>> depth = np.concatenate([np.linspace(-0.004, 0.008, 16), np.linspace(0.008, -0.004, 16)])
>>> places = np.column_stack([np.zeros((32, 2)), depth])
>>> poses = np.arange(32) * 10**8, places, np.tile([0.0, 0.0, 0.0, 1.0], (32, 1))
>>> made = PressModel(model, tissue.materials_for, [], [Pose(place) for place in places])
>>> press = paired(poses, (poses[0], made.predict({"gel": 9e3}).wrenches), tolerance=0.01)
>>> found = fit_stiffness(tissue, press, StiffnessSettings(poses=16))
>>> round(found.moduli["gel"]), found.intervals["gel"].factor < 1.01
(9000, True)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import StiffnessError
from us_sim.tissue.identification.fit import FARTHEST, Fitted, fit
from us_sim.tissue.identification.identifiability import judge
from us_sim.tissue.identification.landmarks import Landmarks
from us_sim.tissue.identification.observations import (
    GROUPS,
    Observations,
    observations_of,
)
from us_sim.tissue.identification.pose_choice import ChosenPoses, choose_poses
from us_sim.tissue.identification.press_model import MaterialsFor, PressModel
from us_sim.tissue.identification.press_record import PressRecord
from us_sim.tissue.identification.pressed_tissue import PressedTissue
from us_sim.tissue.identification.refusal import refusal
from us_sim.tissue.identification.settings import StiffnessSettings
from us_sim.tissue.model import TissueModel

Progress = Callable[[float, str], None]


@dataclass(frozen=True, eq=False)
class Tissue:
    """What is pressed: its mesh and probe, and how its materials follow from moduli."""

    model: TissueModel
    materials_for: MaterialsFor
    moduli: Mapping[str, float]  # Pa, of all structures, with which a fit begins


@dataclass(frozen=True)
class Interval:
    """Of a modulus, in Pa."""

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
    fitted: Fitted
    depths: NDArray[np.float64]  # (K,) m, of the poses that press
    remarks: tuple[str, ...]

    @property
    def modelled(self) -> NDArray[np.float64]:
        """(n,) what the model says of the measurements, offsets included."""
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
        tissue: what is pressed.
        record: the press.
        settings: see `StiffnessSettings`.
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
        tissue.model,
        tissue.materials_for,
        names,
        [record.pose(k) for k in chosen.pressed],
        points,
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
    return _judged(tissue, names, observed, fitted, chosen, settings)


def _fitted_names(tissue: Tissue, record: PressRecord, settings: StiffnessSettings) -> list[str]:
    """The structures whose moduli are looked for."""
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
    """Refuse forces on the tissue where those on the probe are meant."""
    for place, channel in enumerate(observed.channels):
        if channel == 2:
            its = observed.nuisance[:, place] > 0
            measured = observed.values[its] - observed.values[its].mean()
            if measured @ (values[its] - values[its].mean()) < 0.0:
                raise StiffnessError(
                    "the wrench points the other way: the force on the probe falls below zero "
                    "along its z when it is pressed in, and here it rises; turn the sensor's sign"
                )


def _judged(
    tissue: Tissue,
    names: list[str],
    observed: Observations,
    fitted: Fitted,
    chosen: ChosenPoses,
    settings: StiffnessSettings,
) -> StiffnessFit:
    verdict = judge(
        fitted.jacobian,
        fitted.residual,
        fitted.noise,
        observed.nuisance,
        observed.times,
        observed.depths,
        widest=settings.widest,
        confidence=settings.confidence,
    )
    if not verdict.determined.all():
        raise StiffnessError(refusal(names, verdict, observed, fitted, settings))
    if fitted.bounded.any():
        first = names[int(np.argmax(fitted.bounded))]
        raise StiffnessError(
            f"the modulus of {first} runs to {FARTHEST:g} times what the scene says, or that part "
            f"of it: the press contradicts the scene; check the registration, the sensor's "
            f"units and what else is soft, or keep it with --keep {first}"
        )
    moduli = np.exp(fitted.log_moduli)
    factors = np.exp(verdict.half_widths)
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
    )


def _weights(observed: Observations, fitted: Fitted) -> NDArray[np.float64]:
    """(P,) part of the forces (without any, of all that is measured) that each modulus makes."""
    model = observed.values - fitted.residual - observed.nuisance @ fitted.nuisance
    its = observed.groups == (0 if (observed.groups == 0).any() else observed.groups.min())
    size = float(model[its] @ model[its]) or 1.0
    return np.asarray(fitted.jacobian[its].T @ model[its] / size)


def _remarks(chosen: ChosenPoses, observed: Observations, fitted: Fitted) -> tuple[str, ...]:
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
