"""Beads inside an indented hydrogel: the interior is predicted from the motion of a box's faces.

Confocal microscopy of fluorescent beads before and after an indentation gives the displacement
inside a real soft solid. Neither force nor modulus is known, and none is needed: the displacement
of a box's faces is prescribed, and the nonlinear tissue model says where the beads inside went.
Parameters are fitted on beads on one side of the indenter's axis and judged on the other side.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, cached_property, partial
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.sparse import csc_array
from scipy.sparse.linalg import LinearOperator, splu

from us_sim.errors import SolverError
from us_sim.evaluation.block import conjugate_gradients
from us_sim.evaluation.figures import draw_error_over_parameter
from us_sim.evaluation.measured.beads import FILE, Beads, local_fit, read_beads
from us_sim.evaluation.subject import Piece, Place
from us_sim.geometry.collider import Sphere
from us_sim.tissue.elasticity.linear_tetrahedra import lame_stiffness, shape_gradients
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import TissueMaterials, uniform_material
from us_sim.tissue.elasticity.neo_hookean import NeoHookean
from us_sim.tissue.elasticity.springs import springs_of
from us_sim.tissue.mesh.embedding import locate
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
from us_sim.tissue.model import TissueModel
from us_sim.tissue.solvers.newton import Newton

Array = NDArray[np.float64]

_MICRON = 1e-6
_BAND = 6e-6  # m, from a face: beads nearer give the face's displacement, and are not compared
_SIDES = np.array([[45.2e-6, 48e-6], [365.2e-6, 368e-6]])  # m, of all boxes along x and y
_BOTTOM, _TOPS = 24e-6, (60e-6, 72e-6, 92e-6)  # m
_NEAREST, _NEAREST_OF_HALF = 45, 16
"""Beads of a quadratic fit at a face's node, and of the affine fit of the noise floor."""
_LAYERS = 1e-6 * np.array([30.0, 48.0, 60.0, 72.0, 80.0, 86.0])  # m, borders
_MOST_STEPS = 200
_TOLERANCE = 1e-6  # residual norm over that of the harmonic start
_FRAMES, _FRAME_TOLERANCE = 30, 1e-3
_METHODS = ("linear", "nonlinear", "springs")
BEST = "nonlinear, graded"
_AXIS = 205.2e-6  # m, along x
_FITTING_MESH, _MESH = 24e-6, 16e-6  # m
_UNIT = 1e4  # 1/m, unit of softening in a fit: the modulus falls e-fold over 100 um
_START, _STEP = np.array([0.45, 0.0]), np.array([0.03, 1.0])  # Poisson's ratio, softening
_BOUNDS = np.array([[0.0, 0.498], [-2.0, 10.0]])
_OF_SPRINGS = 0.25  # Poisson's ratio of springs alone


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
        balance(newton, _TOLERANCE * newton.residual_norm)
        return newton.displacement.T.copy()

    def springs(self, ratio: float, softening: float = 0.0) -> Array:
        """(N, 3) m, equilibrium of the springs of `msds`.

        The other arguments are those of `nonlinear`, and its error.
        """
        nodes, still = self.mesh.nodes, np.zeros_like(self.faces)
        springs = springs_of(self.mesh, self._model(ratio, softening).materials)
        springs = springs.without(self.fixed)
        free = np.repeat(~self.fixed, 3)

        def residual(field: Array) -> Array:
            return np.asarray(springs.forces(nodes + field, still).ravel()[free])

        field = self.harmonic
        force = residual(field)
        goal = _TOLERANCE * np.linalg.norm(force)
        for _ in range(_MOST_STEPS):
            if np.linalg.norm(force) <= goal:
                return field
            # Gauss and Newton's step, since the energy is a sum of squares
            factor = springs.factor(nodes + field)[:, free]
            step = np.zeros(field.size)
            step[free] = splu(csc_array(factor.T @ factor)).solve(force)
            for length in 0.5 ** np.arange(8):
                tried = field + length * step.reshape(-1, 3)
                if np.linalg.norm(residual(tried)) < np.linalg.norm(force):
                    break
            field, force = tried, residual(tried)
        raise _unbalanced(float(np.linalg.norm(force)), float(goal))

    def solved(self, method: str, ratio: float, softening: float) -> Array:
        """(N, 3) m, by one of `_METHODS`."""
        if method == "springs":
            return self.springs(ratio, softening)
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
            balance(newton, goal)
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


def balance(newton: Newton, goal: float) -> None:
    """Step until the norm of the residual is at most ``goal``, N.

    Raises:
        SolverError: it stays above.
    """
    for _ in range(_MOST_STEPS):
        if newton.residual_norm <= goal:
            return
        newton.step(newton.iteration_limit)
    raise _unbalanced(newton.residual_norm, goal)


def _unbalanced(residual: float, goal: float) -> SolverError:
    return SolverError(
        f"no balance was found: the residual stays at {residual:.2g} N "
        f"where {goal:.2g} N is asked for; its faces move too far for its mesh"
    )


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


def fit_parameters(case: Case, method: str, graded: bool) -> tuple[float, float]:
    """Fit Poisson's ratio, and the softening in 1/m if ``graded``, to the beads on one side."""
    coarse = case.box(_FITTING_MESH)
    free = np.array([method != "springs", graded])
    start = np.where(free, _START, (_OF_SPRINGS, 0.0))

    def parameters(x: Array) -> tuple[float, float]:
        all_of_them = start.copy()
        all_of_them[free] = x
        return float(all_of_them[0]), _UNIT * float(all_of_them[1])

    def misfit(x: Array) -> float:
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
    return parameters(best)


def predict_beads(case: Case, floor: Array, spacing: float) -> Iterator[dict[str, Any]]:
    """Fit on one side of a case's beads, on a coarse mesh, and judge on the other on a finer one.

    Args:
        case: the box.
        floor: (B, 3) m, of all beads.
        spacing: m, of the finer mesh.
    """
    box, noise = case.box(spacing), floor[case.inner]
    fields = {"harmonic": (box.harmonic, np.nan, np.nan)}
    for method, graded in product(_METHODS, (False, True)):
        fitted = fit_parameters(case, method, graded)
        name = f"{method}, graded" if graded else method
        fields[name] = (box.solved(method, *fitted), *fitted)
    errors = {name: case.error(box, field) for name, (field, *_) in fields.items()}
    z = case.beads.places[:, 2]
    parts = {"all": (np.nan, case.judged)}
    for low, high in pairwise(_LAYERS):
        if high <= case.top - _BAND + 1e-9:
            name = f"z {low / _MICRON:.0f} to {high / _MICRON:.0f}"
            middle = (low + high) / 2 / _MICRON
            parts[name] = middle, case.judged & (z >= low) & (z < high)
    for part, (height, chosen) in parts.items():
        for model, (field, ratio, softening) in fields.items():
            best = case.top == _TOPS[-1] and model == BEST and part == "all"
            ratios = box.volume_ratio(field, case.beads.places[chosen])
            yield {
                "case": f"box to {case.top / _MICRON:.0f} um, {part}",
                "quantity": f"rms error, {model}",
                "unit": "um",
                "measured": _length(case.beads.displacement[chosen]) / _MICRON,
                "error": _length(errors[model][chosen]) / _MICRON,
                "floor": _length(noise[chosen]) / _MICRON,
                "fitted_on": ""
                if model in ("harmonic", "springs")
                else "beads inside, other side of the axis",
                "ms": box.frame_ms(ratio, softening) if best else np.nan,
                "panel": f"box to {case.top / _MICRON:.0f} µm",
                "line": model,
                "x": height,
                "poisson_ratio": np.nan if model == "springs" else ratio,
                "height": 1 / softening / _MICRON if softening else np.nan,
                "det_measured": float(np.median(case.beads.volume_ratio[chosen])),
                "det_predicted": float(np.median(ratios)),
            }


def plan_hydrogel(folder: Path, quick: bool) -> list[Piece]:
    """Boxes of three heights; of a quick run, the lowest."""

    def predict(top: float) -> Iterator[dict[str, Any]]:
        beads, floor = _beads_of(folder / FILE)
        return predict_beads(Case(beads, top), floor, _MESH)

    tops = _TOPS[:1] if quick else _TOPS
    return [Piece({"study": "hydrogel"}, partial(predict, top)) for top in tops]


@cache
def _beads_of(file: Path) -> tuple[Beads, Array]:
    beads = read_beads(file)
    return beads, noise_floor(beads, np.random.default_rng(1))


def report_hydrogel(rows: pd.DataFrame) -> tuple[str, dict[str, Place]]:
    """Say how far the beads are off, in all and by height."""
    whole, layers = rows[rows["x"].isna()], rows[rows["x"].notna()]
    over = whole.assign(over=whole["error"] / whole["floor"])
    table = over.pivot_table("over", "line", "panel", sort=False).reset_index(names="error / floor")
    names = {"panel": "box", "line": "model", "poisson_ratio": "Poisson's ratio"}
    names |= {"height": "height for 1/e of the modulus, µm", "error": "error, µm"}
    names |= {"floor": "floor, µm", "det_measured": "det F", "det_predicted": "predicted"}
    figure = draw_error_over_parameter(
        *(layers, "x", "error", "Beads in a gel: error by height above the glass"),
        panels="panel",
        lines="line",
        log="",
        labels={"x": "height, µm", "error": "root mean square error, µm"},
    )
    best, plain = (whole[whole["line"] == line].iloc[-1] for line in (BEST, "linear, graded"))
    words = (
        f"Beads in an indented gel: `{BEST}` is {best['error']:.2f} µm off, `{plain['line']}` "
        f"{plain['error']:.2f}, where they moved by {best['measured']:.1f} and were seen to "
        f"{best['floor']:.2f} µm."
    )
    fitted = whole[list(names)].rename(columns=names)
    return words, {"hydrogel_models": table, "hydrogel": figure, "hydrogel_fitted": fitted}
