"""Beads inside an indented hydrogel: the interior is predicted from the motion of a box's faces.

Confocal microscopy of fluorescent beads before and after an indentation gives the displacement
inside a real soft solid. Neither force nor modulus is known, and none is needed: the displacement
of a box's faces is prescribed, and the nonlinear tissue model says where the beads inside went.
Parameters are fitted on beads on one side of the indenter's axis and judged on the other side.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise, product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.sparse import csc_array
from scipy.sparse.linalg import LinearOperator, splu

from us_sim.errors import SolverError
from us_sim.evaluation.block import conjugate_gradients
from us_sim.evaluation.measured.beads import FILE, Beads, local_fit, read_beads
from us_sim.evaluation.measured.study import Finding, Section, Study
from us_sim.evaluation.report import ReportFolder, filled, markdown_table, picture, plain
from us_sim.evaluation.timing import steps
from us_sim.geometry.collider import Sphere
from us_sim.tissue.elasticity.linear_tetrahedra import lame_stiffness, shape_gradients
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import TissueMaterials, uniform_material
from us_sim.tissue.elasticity.neo_hookean import NeoHookean
from us_sim.tissue.mesh.embedding import locate
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
from us_sim.tissue.model import TissueModel
from us_sim.tissue.solvers.msds import MsdsSettings, spring_tissue
from us_sim.tissue.solvers.newton import Newton

Array = NDArray[np.float64]

_MICRON = 1e-6
_BAND = 6e-6  # m, from a face: beads nearer give the face's displacement, and are not compared
_SIDES = np.array([[45.2e-6, 48e-6], [365.2e-6, 368e-6]])  # m, of all boxes along x and y
_BOTTOM, _TOPS = 24e-6, (60e-6, 72e-6, 92e-6)  # m
_NEAREST, _NEAREST_OF_HALF = 45, 16
"""Beads of a quadratic fit at a face's node, and of the affine fit of the noise floor."""
_PLANE = slice(0, 2)  # x and y
_LAYERS = 1e-6 * np.array([30.0, 48.0, 60.0, 72.0, 80.0, 86.0])  # m, borders
_MOST_STEPS = 200
_TOLERANCE = 1e-6  # residual norm over that of the harmonic start
_FRAMES, _FRAME_TOLERANCE = 30, 1e-3
_METHODS = ("linear", "nonlinear", "springs", "springs and volume")
_SHOWN = ("linear", "nonlinear")  # layer by layer
_BEST, _RIVAL = "nonlinear, graded", "linear, graded"
_AXIS = 205.2e-6  # m, along x
_FITTING_MESH, _MESH = 24e-6, 16e-6  # m
_UNIT = 1e4  # 1/m, unit of softening in a fit: the modulus falls e-fold over 100 um
_START, _STEP = np.array([0.45, 0.0]), np.array([0.03, 1.0])  # Poisson's ratio, softening
_BOUNDS = np.array([[0.0, 0.498], [-2.0, 10.0]])
_OF_SPRINGS = 0.25  # Poisson's ratio of springs alone
_SLABS = 10  # along y, between which errors are taken to be independent


def noise_floor(beads: Beads, random: np.random.Generator) -> Array:
    """(B, 3) m, difference of each bead from the affine fit of the other half around it."""
    order = random.permutation(len(beads.places))
    difference = np.empty_like(beads.displacement)
    for known, asked in ((order[::2], order[1::2]), (order[1::2], order[::2])):
        places = beads.places[asked]
        fit, _ = local_fit(*_moved(beads[known]), places, _NEAREST_OF_HALF)
        difference[asked] = fit - beads.displacement[asked]
    return difference


def faces_fit(beads: Beads, points: Array) -> Array:
    """(P, 3) m, displacement at points (P, 3) m of faces by the beads near them."""
    return local_fit(*_moved(beads), points, _NEAREST, quadratic=True)[0]


def _moved(beads: Beads) -> tuple[Array, Array]:
    return beads.places, beads.displacement


class PrescribedBox:
    """A box of the live solver's elements whose faces move as prescribed.

    Args:
        lower, upper: (3,) m, corners.
        spacing: m, of the mesh, about.
        prescribe: makes the displacement (P, 3) m of points (P, 3) m on the faces.
    """

    def __init__(
        self, lower: Array, upper: Array, spacing: float, prescribe: Callable[[Array], Array]
    ) -> None:
        counts = np.maximum(np.rint((upper - lower) / spacing).astype(int), 2) + 1
        ranges = zip(lower, upper, counts, strict=True)
        self.mesh = box_mesh(*(np.linspace(*ends) for ends in ranges))
        nodes = self.mesh.nodes
        self.fixed = ((nodes == nodes.min(axis=0)) | (nodes == nodes.max(axis=0))).any(axis=1)
        self.faces = np.zeros_like(nodes)  # (N, 3) m, the displacement, zero inside
        self.faces[self.fixed] = prescribe(nodes[self.fixed])

    @cached_property
    def harmonic(self) -> Array:
        """(N, 3) m, the solution of Laplace's equation: interpolation without mechanics."""
        ones = np.ones(len(self.mesh.tetrahedra))
        matrix = lame_stiffness(self.mesh, -ones, ones).tocsr()  # inside, only mu ga.gb I
        return self._solved(lambda field: matrix @ field)

    def linear(self, ratio: float, softening: float = 0.0) -> Array:
        """(N, 3) m, of Hooke's law; arguments as those of `nonlinear`."""
        tissue = NeoHookean(self.mesh, self._materials(ratio, softening), np.float64)

        def product(field: Array) -> Array:
            columns = np.ascontiguousarray(field.reshape(-1, 3).T)
            return np.asarray(tissue.tangent_product(columns).T.ravel())

        return self._solved(product)

    def nonlinear(self, ratio: float, softening: float = 0.0) -> Array:
        """(N, 3) m, the equilibrium of the live solver's model.

        Args:
            ratio: Poisson's.
            softening: 1/m, with which the modulus falls exponentially along z.

        Raises:
            SolverError: it was not found.
        """
        newton = self._newton(ratio, softening)
        newton.set_displacement(np.ascontiguousarray(self.harmonic.T))
        _balance(newton, _TOLERANCE * newton.residual_norm)
        return newton.displacement.T.copy()

    def springs(self, ratio: float, softening: float = 0.0, *, volume: bool = False) -> Array:
        """(N, 3) m, equilibrium of springs: those of `msds`, or fitted ones with volume.

        The other arguments are those of `nonlinear`, and its error.
        """
        nodes, still = self.mesh.nodes, np.zeros_like(self.faces)
        chosen = MsdsSettings(stiffness="fitted", volume=True) if volume else MsdsSettings()
        springs, term = spring_tissue(self._model(ratio, softening), chosen, yielding=False)
        free = np.repeat(~self.fixed, 3)

        def residual(field: Array) -> Array:
            force = springs.forces(nodes + field, still) + term.forces(nodes + field, still)
            return np.asarray(force.ravel()[free])

        field = self.harmonic
        force = residual(field)
        goal = _TOLERANCE * np.linalg.norm(force)
        for _ in range(_MOST_STEPS):
            if np.linalg.norm(force) <= goal:
                return field
            # Gauss and Newton's step, since the energy is a sum of squares
            factors = [part.factor(nodes + field)[:, free] for part in (springs, term)]
            step = np.zeros(field.size)
            step[free] = splu(csc_array(sum(f.T @ f for f in factors))).solve(force)
            for length in 0.5 ** np.arange(8):
                tried = field + length * step.reshape(-1, 3)
                if np.linalg.norm(residual(tried)) < np.linalg.norm(force):
                    break
            field, force = tried, residual(tried)
        raise _unbalanced(float(np.linalg.norm(force)), float(goal))

    def solved(self, method: str, ratio: float, softening: float) -> Array:
        """(N, 3) m, by one of `_METHODS`."""
        if method.startswith("springs"):
            return self.springs(ratio, softening, volume=method != "springs")
        return (self.linear if method == "linear" else self.nonlinear)(ratio, softening)

    def frame_ms(self, ratio: float, softening: float) -> float:
        """ms of processor time, median, where the faces take many frames to their places."""
        newton, step = self._newton(ratio, softening), self.harmonic.T / _FRAMES
        newton.set_displacement(np.ascontiguousarray(self.harmonic.T))
        goal = _FRAME_TOLERANCE * newton.residual_norm
        newton.reset()
        taken = []
        for _ in range(_FRAMES):
            began = time.process_time()
            newton.set_displacement(newton.displacement + step)
            _balance(newton, goal)
            taken.append(1e3 * (time.process_time() - began))
        return float(np.median(taken))

    def at(self, field: Array, points: Array) -> Array:
        """(P, 3) m, a nodal field (N, 3) m at points (P, 3) m."""
        place = locate(self.mesh, points)
        corners = field[self.mesh.tetrahedra[place.tetrahedra]]
        return np.asarray(np.einsum("pa,pad->pd", place.weights, corners))

    def volume_ratio(self, field: Array, points: Array) -> Array:
        """(P,), determinant of the deformation gradient of a nodal field (N, 3) m at points."""
        inside = locate(self.mesh, points).tetrahedra
        gradients = shape_gradients(self.mesh)[inside]
        slope = np.einsum("pai,paj->pij", field[self.mesh.tetrahedra[inside]], gradients)
        return np.asarray(np.linalg.det(np.eye(3) + slope))

    def _materials(self, ratio: float, softening: float) -> TissueMaterials:
        z = self.mesh.nodes[self.mesh.tetrahedra, 2].mean(axis=1)
        made = uniform_material(self.mesh, Material(1e3, ratio, 1e3))
        fall = np.exp(-softening * (z - z.min()))
        return replace(made, young_modulus=made.young_modulus * fall)

    def _newton(self, ratio: float, softening: float) -> Newton:
        return Newton(self._model(ratio, softening))

    def _model(self, ratio: float, softening: float) -> TissueModel:
        materials, nothing = self._materials(ratio, softening), np.zeros(0, dtype=np.int32)
        return TissueModel(self.mesh, materials, self.fixed, Sphere(0.03), nothing)

    def _solved(self, product: Callable[[Array], Array]) -> Array:
        free = np.repeat(~self.fixed, 3).astype(float)
        operator = LinearOperator(
            2 * free.shape, lambda v: free * product(free * v.ravel()), dtype=np.float64
        )
        right = -free * product(self.faces.ravel())
        found = conjugate_gradients(operator, right, 1e-8, None, 20_000)
        return self.faces + np.asarray(found).reshape(-1, 3)


def _balance(newton: Newton, goal: float) -> None:
    for _ in range(_MOST_STEPS):
        if newton.residual_norm <= goal:
            return
        newton.step(newton.iteration_limit)
    raise _unbalanced(newton.residual_norm, goal)


def _unbalanced(residual: float, goal: float) -> SolverError:
    return SolverError(
        f"the hydrogel's balance was not found: its residual stays at {residual:.2g} N "
        f"where {goal:.2g} N is asked for; its faces move too far for its mesh"
    )


@dataclass(frozen=True)
class Outcome:
    """Predictions of the beads in a box of one height, all of them in order of ``beads``."""

    top: float  # m
    beads: Beads  # inside, which gave no face its displacement
    judged: NDArray[np.bool_]  # (B,), the side on which nothing was fitted
    floor: Array  # (B, 3) m
    errors: dict[str, Array]  # (B, 3) m, by method
    fitted: dict[str, tuple[float, float]]  # Poisson's ratio and softening in 1/m, by method
    volume_ratio: dict[str, Array]  # (B,), by method

    def part(self, chosen: NDArray[np.bool_], method: str, axes: slice = slice(None)) -> float:
        """m, root mean square length of the errors of those judged beads that are chosen."""
        return _length(self.errors[method][chosen & self.judged, axes])

    def part_floor(self, chosen: NDArray[np.bool_], axes: slice = slice(None)) -> float:
        """m, the same of the noise floor."""
        return _length(self.floor[chosen & self.judged, axes])

    def apart(self, method: str, other: str) -> tuple[float, float, float]:
        """m, by how much more one method errs than another, with the standard error of that, and
        how far their predictions are apart, all of the judged beads.
        """
        one, two = (self.errors[name][self.judged] for name in (method, other))
        slabs = np.array_split(np.argsort(self.beads.places[self.judged, 1]), _SLABS)
        more = np.array([_length(one[slab]) - _length(two[slab]) for slab in slabs])
        return float(more.mean()), float(more.std(ddof=1) / _SLABS**0.5), _length(one - two)

    @property
    def parts(self) -> dict[str, NDArray[np.bool_]]:
        """(B,), layers by name that have beads, and the whole box."""
        z, found = self.beads.places[:, 2], {}
        for low, high in pairwise(_LAYERS):
            if high <= self.top - _BAND + 1e-9:
                found[f"z {low / _MICRON:.0f} to {high / _MICRON:.0f}"] = (z >= low) & (z < high)
        return found | {"all": np.ones(len(z), dtype=bool)}


def _length(vectors: Array) -> float:
    return float(np.sqrt((vectors**2).sum(axis=1).mean())) if len(vectors) else float("nan")


class Case:
    """A box of one height: its faces' displacement by beads near them, and the beads inside."""

    def __init__(self, beads: Beads, top: float) -> None:
        self.top = top
        self.lower, self.upper = np.append(_SIDES[0], _BOTTOM), np.append(_SIDES[1], top)
        places = beads.places
        depth = np.minimum(places - self.lower, self.upper - places).min(axis=1)
        self.near, self.inner = beads[abs(depth) < _BAND], depth >= _BAND
        self.beads = beads[self.inner]
        self.judged = self.beads.places[:, 0] > _AXIS

    def box(self, spacing: float) -> PrescribedBox:
        """The mesh, of a spacing in m."""
        return PrescribedBox(self.lower, self.upper, spacing, partial(faces_fit, self.near))

    def error(self, box: PrescribedBox, field: Array) -> Array:
        """(B, 3) m."""
        return box.at(field, self.beads.places) - self.beads.displacement


def outcome(case: Case, floor: Array, spacing: float) -> Outcome:
    """Fit on one side of a case's beads, on a coarse mesh, and predict all on a finer one."""
    coarse, box = case.box(_FITTING_MESH), case.box(spacing)
    fields, fitted = {"harmonic": box.harmonic}, {}
    for method, graded in product(_METHODS, (False, True)):
        free = np.array([method != "springs", graded])
        start = np.where(free, _START, (_OF_SPRINGS, 0.0))

        def parameters(
            x: Array, free: NDArray[np.bool_] = free, start: Array = start
        ) -> tuple[float, float]:
            all_of_them = start.copy()
            all_of_them[free] = x
            return float(all_of_them[0]), _UNIT * float(all_of_them[1])

        def misfit(
            x: Array,
            method: str = method,
            parameters: Callable = parameters,  # type: ignore[type-arg]
        ) -> float:
            error = case.error(coarse, coarse.solved(method, *parameters(x)))
            return 1e6 * _length(error[~case.judged])

        best = start[free]
        if len(best):
            simplex = np.vstack([best, best + np.diag(_STEP[free])])
            best = minimize(
                *(misfit, best),
                method="Nelder-Mead",
                bounds=_BOUNDS[free],
                options={"initial_simplex": simplex, "xatol": 5e-3},
            ).x
        name = f"{method}, graded" if graded else method
        fitted[name] = parameters(best)
        fields[name] = box.solved(method, *fitted[name])
    errors = {name: case.error(box, field) for name, field in fields.items()}
    places = case.beads.places
    ratios = {name: box.volume_ratio(field, places) for name, field in fields.items()}
    floor = floor[case.inner]
    return Outcome(case.top, case.beads, case.judged, floor, errors, fitted, ratios)


def measure_hydrogel(folder: Path, report: ReportFolder) -> Section:
    """Predict the beads in boxes of three heights, and in the tallest on several meshes."""
    beads = read_beads(folder / FILE)
    floor = noise_floor(beads, np.random.default_rng(1))
    spacings = (24e-6, 16e-6) if report.quick else (24e-6, 16e-6, 12e-6, 8.5e-6)
    cases = steps(
        "hydrogel", [Case(beads, top) for top in _TOPS], "boxes", lambda c: f"{c.top:g} m"
    )
    outcomes = [outcome(case, floor, 16e-6) for case in cases]
    case, parameters = Case(beads, _TOPS[-1]), outcomes[-1].fitted[_BEST]
    meshes = [_Mesh.measured(case, spacing, parameters) for spacing in spacings]
    findings = [
        Finding(
            *("hydrogel", f"box to {o.top / _MICRON:.0f} um, {part}", f"rms error, {method}", "um"),
            measured=_length(o.beads.displacement[chosen & o.judged]) / _MICRON,
            error=o.part(chosen, method) / _MICRON,
            floor=o.part_floor(chosen) / _MICRON,
            fitted_on=""
            if method in ("harmonic", "springs")
            else "beads inside, other side of the axis",
            ms=meshes[1].ms if o is outcomes[-1] and method == _BEST else float("nan"),
            headline=o is outcomes[-1] and part == "all",
        )
        for o in outcomes
        for part, chosen in o.parts.items()
        for method in o.errors
    ]
    _draw_section(outcomes[-1], report.picture("hydrogel_section"))
    _draw_errors(outcomes, report.picture("hydrogel_errors"))
    text = filled(
        *("measured", "hydrogel"),
        count=str(len(beads.places)),
        inside=str(len(outcomes[-1].beads.places)),
        table=_table(outcomes),
        methods=_method_table(outcomes),
        top=f"{case.top / _MICRON:.0f}",
        tie=", ".join(
            f"{more / _MICRON:.3f} ± {deviation / _MICRON:.3f}"
            for more, deviation, _ in (outcomes[-1].apart(_RIVAL, _BEST),)
        ),
        apart=f"{outcomes[-1].apart(_RIVAL, _BEST)[2] / _MICRON:.3f}",
        slabs=str(_SLABS),
        fitted=_fitted_table(outcomes),
        meshes=_mesh_table(meshes),
    )
    return Section("Beads inside an indented hydrogel", text, findings)


@dataclass(frozen=True)
class _Mesh:
    """A mesh of the tallest box, and the error on it in m of the judged beads."""

    spacing: float  # m
    nodes: int
    error: float
    ms: float  # of a frame

    @classmethod
    def measured(cls, case: Case, spacing: float, parameters: tuple[float, float]) -> _Mesh:
        box = case.box(spacing)
        error = case.error(box, box.nonlinear(*parameters))[case.judged]
        ms = box.frame_ms(*parameters)
        return cls(spacing, len(box.mesh.nodes), _length(error), ms)


def _table(outcomes: list[Outcome]) -> str:
    shown = ["harmonic", *(f"{method}{more}" for method in _SHOWN for more in ("", ", graded"))]
    rows = []
    for o in outcomes:
        for part, chosen in o.parts.items():
            floor = o.part_floor(chosen)
            moved = _length(o.beads.displacement[chosen & o.judged])
            errors = [o.part(chosen, method) for method in shown]
            rows.append(
                (
                    *(f"{o.top / _MICRON:.0f}", part, str(int((chosen & o.judged).sum()))),
                    f"{np.median(o.beads.volume_ratio[chosen]):.3f}",
                    *(f"{np.median(o.volume_ratio[m][chosen]):.3f}" for m in ("nonlinear", _BEST)),
                    *(f"{length / _MICRON:.2f}" for length in (moved, floor, *errors)),
                    *(f"{o.part(chosen, m) / floor:.2f}" for m in ("nonlinear", _BEST)),
                    f"{o.part(chosen, _BEST, _PLANE) / o.part_floor(chosen, _PLANE):.2f}",
                )
            )
    head = ("box to, µm", "layer, µm", "beads", "det F", "nonlinear: det F", "graded: det F")
    ratios = ("nonlinear over floor", "graded over floor", "the same in plane")
    return markdown_table((*head, "moved", "floor", *shown, *ratios), rows)


def _method_table(outcomes: list[Outcome]) -> str:
    """Error of the whole box, in µm and over the floor."""
    rows = []
    for method in outcomes[0].errors:
        whole = [(o.part(o.parts["all"], method), o.part_floor(o.parts["all"])) for o in outcomes]
        rows.append((method, *(f"{e / _MICRON:.2f} ({e / floor:.2f})" for e, floor in whole)))
    heads = (f"box to {o.top / _MICRON:.0f} µm" for o in outcomes)
    return markdown_table(("model", *heads), rows)


def _fitted_table(outcomes: list[Outcome]) -> str:
    rows = [
        (
            f"{o.top / _MICRON:.0f}",
            name,
            "" if name.split(",")[0] == "springs" else f"{ratio:.3f}",
            f"{1 / softening / _MICRON:.0f}" if softening else "",
        )
        for o in outcomes
        for name, (ratio, softening) in o.fitted.items()
    ]
    head = ("box to, µm", "model", "Poisson's ratio", "height for 1/e of the modulus, µm")
    return markdown_table(head, rows)


def _mesh_table(meshes: list[_Mesh]) -> str:
    rows = [
        (f"{m.spacing / _MICRON:g}", str(m.nodes), f"{m.error / _MICRON:.3f}", f"{m.ms:.1f}")
        for m in meshes
    ]
    return markdown_table(("mesh, µm", "nodes", "error, µm", "ms a frame"), rows)


def _draw_section(o: Outcome, file: Path) -> None:
    """Beads near the plane through the axis: measured and predicted motion, and the difference."""
    places = o.beads.places / _MICRON
    chosen = abs(places[:, 1] - 208) < 12
    x, z = places[chosen, 0], places[chosen, 2]
    measured = o.beads.displacement[chosen] / _MICRON
    error = o.errors[_BEST][chosen] / _MICRON
    title = "Beads near the indenter's axis: what was measured, what was predicted, the difference"
    with picture(file, 13, 8.5, title) as figure:
        panels = figure.subplots(3, 1, sharex=True)
        shown = (("measured", measured), ("predicted", measured + error), ("difference", error))
        for panel, (name, vectors) in zip(panels, shown, strict=True):
            times = 5 if name == "difference" else 1
            arrows = panel.quiver(
                *(x, z, vectors[:, 0], vectors[:, 2], np.linalg.norm(vectors, axis=1)),
                angles="xy",
                scale_units="xy",
                scale=1 / times,
                width=0.0015,
                cmap="viridis",
                clim=(0, 10 / times),
            )
            drawn = f", drawn {times} times as long" if times > 1 else ""
            panel.set_title(name + drawn, fontsize=11, loc="left")
            panel.set(ylabel="z, µm", aspect="equal")
            plain(panel)
            figure.colorbar(arrows, ax=panel, label="µm")
        panels[-1].set_xlabel("x, µm")


def _draw_errors(outcomes: list[Outcome], file: Path) -> None:
    """Error of each method by height, beside the noise floor, a panel a box."""
    looks = {
        "harmonic": ("0.6", "o-"),
        "linear": ("#9ecae1", "o-"),
        "linear, graded": ("#3182bd", "s-"),
        "springs and volume": ("#a1d99b", "o-"),
        "springs and volume, graded": ("#31a354", "s-"),
        "nonlinear": ("#fdae6b", "o-"),
        _BEST: ("#d7301f", "s-"),
    }
    title = "Error inside the box by height above its bottom, beside the noise of the measurement"
    with picture(file, 13, 4.4, title) as figure:
        panels = figure.subplots(1, len(outcomes), sharey=True, sharex=True)
        for panel, o in zip(panels, outcomes, strict=True):
            z = o.beads.places[:, 2]
            borders = np.arange(_BOTTOM + _BAND, o.top - _BAND + 1e-9, 6e-6)
            layers = [(z >= a) & (z < b) for a, b in pairwise(borders)]
            middles = (borders[:-1] + borders[1:]) / 2 / _MICRON
            for name, (colour, look) in looks.items():
                errors = [o.part(layer, name) / _MICRON for layer in layers]
                size = 7 if name == _RIVAL else 4  # the other lies on it
                panel.plot(errors, middles, look, ms=size, color=colour, label=name)
            floor = np.array([o.part_floor(layer) / _MICRON for layer in layers])
            panel.plot(floor, middles, "k--", label="noise floor")
            panel.plot(1.5 * floor, middles, "k:", label="1.5 times that")
            panel.set_title(f"faces up to {o.top / _MICRON:.0f} µm", fontsize=11, loc="left")
            panel.set_xlabel("root mean square error, µm")
            plain(panel)
        panels[0].set_ylabel("z, µm")
        panels[0].legend(fontsize=8, frameon=False, loc="upper right")


STUDY = Study(
    "hydrogel",
    "hydrogel-indentation",
    "https://github.com/FranckLab/SerialTrack, revision fdb01c6204e10dc66d5c6baff75f2cfbd904a4d2, "
    f"the file SerialTrack3D/results/{FILE}",
    "MIT",
    "J. Yang, Y. Yin, A. K. Landauer, S. Buyukozturk, J. Zhang, L. Summey, A. McGhee, M. K. Fu, "
    "J. O. Dabiri and C. Franck, SerialTrack, SoftwareX 19, 101204, 2022.",
    measure_hydrogel,
)
