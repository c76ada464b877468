"""Silicone cylinders compressed to two thirds, and what the model of the tissue predicts.

A modulus comes from the compressions below 5 % of the first specimen of a material, and predicts
the forces on the second one. Nobody said how well the platens slid, so that the truth lies between
two cases: they slid, so that the cylinder stays one, with a closed form; or they stuck, which
`stuck_cylinder` solves. Force over shear modulus is then a function of compression alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import UsSimError
from us_sim.evaluation.measured.stuck_cylinder import StuckCylinder
from us_sim.evaluation.measured.study import Finding, Section, Study
from us_sim.evaluation.report import ReportFolder, filled, markdown_table, picture, plain
from us_sim.evaluation.timing import medians_in_turn, steps
from us_sim.geometry.pose import Pose
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.model import TissueModel
from us_sim.tissue.solvers.fem_nonlinear import FemNonlinear

Array = NDArray[np.float64]

RADIUS, HEIGHT = 0.025, 0.03  # m
_STEP = 0.01
COMPRESSIONS = np.arange(0.0, 0.6651, _STEP)  # parts of the height, at which forces are compared
_FITTED = 0.05  # Compression up to which a modulus is fitted
_STIFFENED = 0.60  # Compression at which a stiffening is fitted
_EARLY = 0.50  # The same, for a prediction of that at 60 %
_SMALL, _LARGE = (0.1, 0.2, 0.3), (0.4, 0.5, 0.66)  # Compressions at which forces are predicted
_HEADLINES = (0.3, 0.66)  # Those that the report's first table has
_COLUMNS = (*_SMALL, *_LARGE[:-1], _STIFFENED, _LARGE[-1])
# Compressions of the findings, by that at which the stiffening was fitted
_TOLD = {None: (*_SMALL, _LARGE[-1]), _STIFFENED: _LARGE, _EARLY: (_STIFFENED,)}
_NODES = (17, 9, 9)  # Of the block under a probe of which a frame is timed
_HEADING = "Time (s)"
_SHOWN = ("EF10_100T", "EF10_0T", "EF50_0T")


def at(compression: float) -> int:
    """The index in `COMPRESSIONS`."""
    return round(compression / _STEP)


@dataclass(frozen=True, eq=False)
class Silicone:
    """Forces of the tests of one material."""

    name: str
    first: Array  # (T, C) N, of one specimen
    second: Array  # (U, C) N, of the other

    @property
    def scatter(self) -> Array:
        """(C,), standard deviation of a test over the mean of all."""
        tests = np.concatenate([self.first, self.second])
        mean = tests.mean(axis=0)
        return np.divide(tests.std(axis=0, ddof=1), mean, out=np.zeros_like(mean), where=mean > 0)


def read_test(file: Path) -> Array:
    """(C,) N, forces of a test at `COMPRESSIONS`.

    Raises:
        UsSimError: the file is no such test, or ends before it is pressed that far.
    """
    lines = file.read_text(encoding="utf-8", errors="replace").splitlines()
    start = next((k for k, line in enumerate(lines) if line.startswith(_HEADING)), None)
    if start is None:
        raise UsSimError(f"{file}: has no line that begins with {_HEADING}: is it a compression?")
    rows = []
    for number, line in enumerate(lines[start + 1 :], start + 2):
        try:
            millimetres, newtons = (float(text) for text in line.split(",")[1:3])
        except ValueError as error:
            raise UsSimError(
                f"{file}:{number}: is no row of time, compression and load: {line[:60]}"
            ) from error
        rows.append((millimetres, newtons))
    table = np.array(rows).reshape(-1, 2)
    part = 1e-3 * np.maximum.accumulate(table[:, 0]) / HEIGHT
    if not np.isfinite(table).all() or not len(table) or part[-1] < COMPRESSIONS[-1]:
        raise UsSimError(
            f"{file}: ends before {100 * COMPRESSIONS[-1]:.0f} % of compression, or holds numbers "
            f"that are none: fetch it again"
        )
    return np.interp(COMPRESSIONS, part, table[:, 1])


def read_silicones(folder: Path) -> list[Silicone]:
    """All materials in a folder of folders, by name.

    Raises:
        UsSimError: there is none, or one has no test of a specimen A or B.
    """
    found = []
    for place in sorted(path for path in folder.glob("*") if path.is_dir()):
        tests = [sorted(place.glob(f"*_{specimen}[0-9].csv")) for specimen in "AB"]
        if not all(tests):
            raise UsSimError(f"{place}: needs tests of specimens A and B, NAME_A1.csv and so on")
        first, second = (np.stack([read_test(file) for file in files]) for files in tests)
        found.append(Silicone(place.name, first, second))
    if not found:
        raise UsSimError(f"{folder}: holds no folder of a silicone's compressions")
    return found


def slipping_force(compression: Array, stiffening: float = 0.0) -> Array:
    """(C,) m2, force over shear modulus of an incompressible cylinder that slides at the platens.

    A pi R^2 (1 + s e^2) (1 / l^2 - l), with l = 1 - compression and e = (l^2 + 2 / l - 3) / 2.
    """
    left = 1.0 - compression
    beyond = (left**2 + 2.0 / left - 3.0) / 2.0
    area = math.pi * RADIUS**2
    return np.asarray(area * (1.0 + stiffening * beyond**2) * (left**-2 - left))


class Platens:
    """Force over shear modulus at `COMPRESSIONS`, for stiffenings between those computed.

    Args:
        curves: (C,) m2 by stiffening.
    """

    def __init__(self, curves: Mapping[float, Array]) -> None:
        self._stiffenings = np.array(sorted(curves))
        self._curves = np.stack([curves[s] for s in self._stiffenings])

    def force(self, stiffening: float = 0.0) -> Array:
        """(C,) m2."""
        some = [np.interp(stiffening, self._stiffenings, curve) for curve in self._curves.T]
        return np.array(some)

    def modulus(self, forces: Array) -> float:
        """Pa, the shear modulus that fits forces (C,) N up to 5 % of compression best."""
        small = slice(1, at(_FITTED) + 1)
        model = self.force()[small]
        return float(model @ forces[small] / (model @ model))

    def stiffening(self, forces: Array, modulus: float, compression: float) -> float:
        """The one with the force at a compression, or the nearest that was computed."""
        there = at(compression)
        return float(np.interp(forces[there] / modulus, self._curves[:, there], self._stiffenings))


def sliding() -> Platens:
    """Platens along which the cylinder slides. Forces are linear in the stiffening."""
    return Platens({s: slipping_force(COMPRESSIONS, s) for s in (0.0, 2.0)})


def sticking(counts: tuple[int, int], stiffenings: Sequence[float]) -> Platens:
    """Platens to which the cylinder sticks, of so many cells across and along it."""
    curves = {}
    coarse = np.array([0.01, 0.03, *np.arange(0.05, 0.66, 0.05), COMPRESSIONS[-1]])
    for stiffening in steps("silicone", stiffenings, "cylinders"):
        forces = StuckCylinder(RADIUS, HEIGHT, counts, stiffening).press(coarse.tolist())
        ratio = np.interp(COMPRESSIONS, coarse, forces / slipping_force(coarse, stiffening))
        curves[stiffening] = ratio * slipping_force(COMPRESSIONS, stiffening)
    return Platens(curves)


@dataclass(frozen=True, eq=False)
class Prediction:
    """The second specimen's forces as the first one's constants predict them."""

    silicone: Silicone
    platens: Platens
    modulus: float  # Pa, of shear, from up to 5 %
    stiffening: float  # from 60 %
    early: float  # the stiffening from 50 %

    @classmethod
    def of(cls, silicone: Silicone, platens: Platens) -> Prediction:
        """Fit the first specimen."""
        mean = silicone.first.mean(axis=0)
        modulus = platens.modulus(mean)
        late, early = (platens.stiffening(mean, modulus, there) for there in (_STIFFENED, _EARLY))
        return cls(silicone, platens, modulus, late, early)

    def force(self, stiffening: float = 0.0) -> Array:
        """(C,) N."""
        return self.modulus * self.platens.force(stiffening)

    def error(self, compression: float, stiffening: float = 0.0) -> float:
        """Of the force, over the second specimen's mean."""
        there = at(compression)
        return float(self.force(stiffening)[there] / self.silicone.second[:, there].mean() - 1.0)


def measure_silicone(folder: Path, report: ReportFolder) -> Section:
    """Compare predictions with the compressions in ``folder``, and draw them.

    Raises:
        UsSimError: a test is missing or cannot be read.
    """
    silicones = read_silicones(folder / "data")
    counts, stiffenings = (
        ((8, 8), (0.0, 0.5)) if report.quick else ((14, 14), (0.0, 0.15, 0.3, 0.6, 1.0))
    )
    cases = {"slip": sliding(), "stick": sticking(counts, stiffenings)}
    made = [
        {name: Prediction.of(silicone, platens) for name, platens in cases.items()}
        for silicone in silicones
    ]
    file = report.picture("silicone")
    _draw(file, [each for each in made if each["slip"].silicone.name in _SHOWN] or made[:3])
    ms = _frame_ms()
    medians = _medians(made)
    text = filled(
        "measured",
        "silicone",
        materials=str(len(silicones)),
        medians=_median_table(medians, [_scatter(made, c) for c in _COLUMNS]),
        table=_table(made),
        cells=f"{counts[0]} cells across and {counts[1]} along it",
        plain=f"{ms[0]:.1f}",
        stiffening=f"{ms[1]:.1f}",
        nodes=f"{math.prod(_NODES):,}",
        picture=file.name,
    )
    rows = [
        Finding(
            study="silicone",
            case=f"median of {len(silicones)} silicones",
            quantity=f"force at {100 * compression:.0f} %, {platens}, {_law(stiffened)}",
            unit="%",
            error=error,
            floor=_scatter(made, compression),
            fitted_on=f"specimen A: {_fitted_on(stiffened)}",
            ms=ms[stiffened is not None],
            headline=compression in _HEADLINES and stiffened != _EARLY,
        )
        for (platens, stiffened), errors in medians.items()
        for compression, error in errors.items()
        if compression in _TOLD[stiffened]
    ]
    return Section("Silicones under compression", text, rows)


def _law(stiffened: float | None) -> str:
    return "neo-Hookean" if stiffened is None else f"stiffening, s from {100 * stiffened:.0f} %"


def _fitted_on(stiffened: float | None) -> str:
    small = f"below {100 * _FITTED:.0f} %"
    return small if stiffened is None else f"{small} and at {100 * stiffened:.0f} %"


def _frame_ms() -> tuple[float, float]:
    """Processor time of a frame of `fem_nonlinear` under a moving sphere, without and with."""
    work = {
        name: FemNonlinear(
            TissueModel.block(nodes=_NODES, material=Material(10e3, stiffening=stiffening))
        ).deform
        for name, stiffening in (("without", 0.0), ("with", 0.3))
    }

    def pose(k: int) -> Pose:
        return Pose(np.array([0.02 * math.sin(k / 10), 0.0, 0.02 * math.sin(k / 20) ** 2 + 0.005]))

    times = medians_in_turn(work, 60, 10, prepare=pose, all_threads=True)
    return times["without"], times["with"]


def _scatter(made: Sequence[Mapping[str, Prediction]], compression: float) -> float:
    """%, median over the materials."""
    return 100 * float(np.median([e["slip"].silicone.scatter[at(compression)] for e in made]))


def _table(made: Sequence[Mapping[str, Prediction]]) -> str:
    """One row a material; two numbers in a cell are with slip and with stick."""
    rows = []
    for each in made:
        silicone, both = each["slip"].silicone, each.values()
        scatter = [f"{100 * silicone.scatter[at(c)]:.0f}" for c in (*_SMALL, _LARGE[-1])]
        plain_law = [[its.error(c) for its in both] for c in (*_SMALL, _LARGE[-1])]
        late = [[its.error(c, its.stiffening) for its in both] for c in _LARGE]
        rows.append(
            (
                silicone.name,
                ", ".join(f"{3e-3 * its.modulus:.1f}" for its in both),
                ", ".join(f"{its.stiffening:.2f}" for its in both),
                ", ".join(scatter),
                *(", ".join(f"{100 * e:+.0f}" for e in errors) for errors in plain_law + late),
            )
        )
    heads = ["silicone", "E, kPa", "s", "scatter"]
    heads += [f"{100 * c:.0f} %" for c in (*_SMALL, _LARGE[-1])]
    return markdown_table([*heads, *(f"{100 * c:.0f} %, s" for c in _LARGE)], rows)


_Medians = Mapping[tuple[str, float | None], Mapping[float, float]]
"""% by compression; for each platens, and the compression at which the stiffening was fitted."""


def _medians(made: Sequence[Mapping[str, Prediction]]) -> _Medians:
    """Median size of the errors over the materials."""
    medians = {}
    for name in made[0]:
        its = [each[name] for each in made]
        for stiffened, constants in (
            (None, [0.0 for _ in its]),
            (_STIFFENED, [one.stiffening for one in its]),
            (_EARLY, [one.early for one in its]),
        ):
            pairs = list(zip(its, constants, strict=True))
            medians[name, stiffened] = {
                c: 100 * float(np.median([abs(one.error(c, s)) for one, s in pairs]))
                for c in _COLUMNS
            }
    return medians


def _median_table(medians: _Medians, scatter: Sequence[float]) -> str:
    rows = [
        (name, _law(stiffened), *(f"{error:.1f}" for error in errors.values()))
        for (name, stiffened), errors in medians.items()
    ]
    rows.append(("", "scatter of tests", *(f"{size:.1f}" for size in scatter)))
    return markdown_table(["platens", "law", *(f"{100 * c:.0f} %" for c in _COLUMNS)], rows)


def _draw(file: Path, shown: Sequence[Mapping[str, Prediction]]) -> None:
    percent = 100 * COMPRESSIONS
    title = "Silicones compressed: force of the tests (grey) and as predicted, and its error"
    with picture(file, 11.0, 6.6, title) as figure:
        panels = figure.subplots(2, len(shown), squeeze=False, sharex=True)
        for (upper, lower), each in zip(panels.T, shown, strict=True):
            silicone = each["slip"].silicone
            mean = silicone.second.mean(axis=0)
            tests = np.concatenate([silicone.first, silicone.second])
            upper.plot(percent, tests.T, color="0.6", lw=0.7)
            lower.fill_between(
                percent,
                *(sign * 100 * silicone.scatter for sign in (-1, 1)),
                color="0.85",
                label="scatter",
            )
            for stiffens, colour, label in (
                (False, "tab:orange", "neo-Hookean"),
                (True, "tab:blue", "stiffening"),
            ):
                forces = [its.force(its.stiffening if stiffens else 0.0) for its in each.values()]
                low, high = np.min(forces, axis=0), np.max(forces, axis=0)
                upper.fill_between(percent, low, high, color=colour, alpha=0.5, label=label)
                some = slice(at(0.02), None)
                parts = [100 * (bound / np.maximum(mean, 1e-9) - 1)[some] for bound in (low, high)]
                lower.fill_between(percent[some], *parts, color=colour, alpha=0.5, label=label)
            upper.set_title(silicone.name, fontsize=11, loc="left")
            lower.set_xlabel("compression, %")
            lower.set_ylim(-60, 60)
            plain(upper)
            plain(lower)
        panels[0, 0].set_ylabel("force, N")
        panels[1, 0].set_ylabel("error of the force, %")
        panels[0, 0].legend(fontsize=8, frameon=False)
        panels[1, 0].legend(fontsize=8, frameon=False, loc="lower left")


STUDY = Study(
    name="silicone",
    folder="ecoflex-compression",
    address="https://github.com/abubakardawood/tissue-phantom-material-database, revision "
    "52b1271f0f8a966c168e5ddc0886190f12c6551f",
    licence="CC BY 4.0",
    citation="A. B. Dawood et al., Tissue Phantom Material Database: Hyperelastic "
    "Characterisation of Silicone Tissue Phantoms, 2026.",
    measure=measure_silicone,
)
