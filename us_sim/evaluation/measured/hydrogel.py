"""Beads inside an indented hydrogel: the interior is predicted from the motion of a box's faces.

Confocal microscopy of fluorescent beads before and after an indentation gives the displacement
inside a real soft solid. Neither force nor modulus is known, and none is needed: the displacement
of a box's faces is prescribed, and the nonlinear tissue model predicts that of the beads inside.
Parameters are fitted on beads on one side of the indenter's axis and judged on the other side.

The authors of SerialTrack (J. Yang et al., SoftwareX 19, 101204, 2022) linked most beads; where
the strain is large many are unlinked. Their sure links, deep in the gel, are the seeds; from there
links grow upwards: a local affine fit of its linked neighbours predicts the place of an unlinked
bead, which is linked with the nearest bead there if each is the other's nearest.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.interpolate import RBFInterpolator
from scipy.io import loadmat
from scipy.sparse.linalg import spsolve
from scipy.spatial import KDTree

from us_sim.errors import SolverError, UsSimError
from us_sim.evaluation.figures import draw_lines
from us_sim.evaluation.subject import Piece, Place
from us_sim.geometry.collider import Sphere
from us_sim.tissue.elasticity.linear_tetrahedra import assemble_lame_stiffness
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import make_uniform_materials
from us_sim.tissue.mesh.embedding import locate_points
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
from us_sim.tissue.model import TissueModel
from us_sim.tissue.solvers.newton import Newton

Array = NDArray[np.float64]

FILE = "results_3D_hardpar.mat"

_MICRON = 1e-6
_PIXEL = 0.4e-6  # m, of the authors' script
_SURE, _REACH = 48e-6, 1e-6  # m: height up to which links are seeds; radius around a prediction
_NEIGHBOURS, _LEAST_NEIGHBOURS = 24, 8  # and how many of them must be linked for a prediction
_WELL_LINKED = 0.7  # part of a bead's neighbours that must be linked, or its own link may be wrong
_NEAREST, _NEAREST_AT_FACES = 20, 45  # beads of an affine fit, and of a quadratic one at a face
_LOWER, _UPPER = 1e-6 * np.array([[45.2, 48.0, 24.0], [365.2, 368.0, 92.0]])  # m, of the box
_BAND = 6e-6  # m, from a face: beads nearer give the face's displacement, and are not compared
_LAYERS = 1e-6 * np.array([30.0, 48.0, 60.0, 72.0, 80.0, 86.0])  # m, borders
_AXIS = 205.2e-6  # m, of the indenter, along x
_FITTING_MESH, _MESH = 24e-6, 16e-6  # m
_MOST_STEPS, _TOLERANCE = 200, 1e-6  # of Newton's; residual norm over the harmonic start's
_RATIOS = (0.1, 0.2, 0.3, 0.45, 0.49)
_HEIGHTS = (18e-6, 20e-6, 22e-6, 24e-6, 28e-6)  # m, over which the modulus falls to 1/e


def fit_near(places: Array, moved: Array, points: Array, nearest: int, degree: int = 1) -> Array:
    """Evaluate at points (P, 3) least-squares polynomials of the nearest places (B, 3): (P, 3)."""
    return np.asarray(
        # Radial functions of micrometres vanish beside this smoothing; polynomials are left.
        RBFInterpolator(places, moved, neighbors=nearest, smoothing=1.0, degree=degree)(points)
    )


def read_beads(file: Path) -> tuple[Array, Array]:
    """Read places (B, 3) m and displacements (B, 3) m of well linked beads.

    Raises:
        UsSimError: the file is none of SerialTrack's results, or is damaged.
    """
    try:
        content = loadmat(file)
        before, after = (
            _PIXEL * np.asarray(places, dtype=float) for places in content["parCoord_prev"].ravel()
        )
        links = content["track_A2B_prev"].ravel()[0].ravel().astype(np.int64) - 1
        partners = grow_links(before, after, np.where(before[:, 2] < _SURE, links, -1))
    except Exception as error:  # of a damaged file SciPy raises anything
        raise UsSimError(
            f"{file}: cannot be read as SerialTrack's results ({error}); fetch it again"
        ) from error
    linked = partners >= 0
    well = linked & (linked[_find_neighbours(before)].mean(axis=1) > _WELL_LINKED)
    return before[well], after[partners[well]] - before[well]


def grow_links(before: Array, after: Array, seeds: NDArray[np.int64]) -> NDArray[np.int64]:
    """Link beads before (A, 3) m with those after (B, 3) m, from seeds (A,): indices or -1."""
    links, neighbours = seeds.copy(), _find_neighbours(before)
    while True:
        linked = links >= 0
        ready = np.flatnonzero(~linked & (linked[neighbours].sum(axis=1) >= _LEAST_NEIGHBOURS))
        left = np.setdiff1d(np.arange(len(after)), links[linked])
        if not len(ready) or not len(left):
            return links
        moved = after[links[linked]] - before[linked]
        expected = before[ready] + fit_near(before[linked], moved, before[ready], _NEAREST)
        distance, found = KDTree(after[left]).query(expected)
        _, back = KDTree(expected).query(after[left])
        sure = (distance < _REACH) & (back[found] == np.arange(len(ready)))
        if not sure.any():
            return links
        links[ready[sure]] = left[found[sure]]


def _find_neighbours(places: Array) -> NDArray[np.int64]:
    return np.asarray(KDTree(places).query(places, _NEIGHBOURS + 1)[1][:, 1:])


class PrescribedBox:
    """A box of the live solver's elements, whose faces move like the beads near them.

    Args:
        places: (B, 3) m, of the beads.
        moved: (B, 3) m, their displacements.
        spacing: m, of the mesh, about.
    """

    def __init__(self, places: Array, moved: Array, spacing: float) -> None:
        counts = np.rint((_UPPER - _LOWER) / spacing).astype(int) + 1
        ends = zip(_LOWER, _UPPER, counts, strict=True)
        self.mesh = box_mesh(*(np.linspace(*end) for end in ends))
        nodes = self.mesh.nodes
        self.fixed = ((nodes == nodes.min(axis=0)) | (nodes == nodes.max(axis=0))).any(axis=1)
        #: (N, 3) m, the solution of Laplace's equation: interpolation without mechanics.
        self.harmonic = np.zeros_like(nodes)
        self.harmonic[self.fixed] = fit_near(
            places, moved, nodes[self.fixed], _NEAREST_AT_FACES, degree=2
        )
        ones = np.ones(len(self.mesh.tetrahedra))
        matrix = assemble_lame_stiffness(self.mesh, -ones, ones).tocsr()  # inside, only mu ga.gb I
        free = np.repeat(~self.fixed, 3)
        pull = (matrix @ self.harmonic.ravel())[free]
        inside = spsolve(matrix[free][:, free].tocsc(), -pull)
        self.harmonic[~self.fixed] = inside.reshape(-1, 3)

    def find_equilibrium(self, ratio: float, height: float = np.inf) -> Array:
        """Find the displacement (N, 3) m of the live solver's model.

        Args:
            ratio: Poisson's.
            height: m, over which the modulus falls to 1/e along z.

        Raises:
            SolverError: there is no balance.
        """
        z = self.mesh.nodes[self.mesh.tetrahedra, 2].mean(axis=1)
        materials = make_uniform_materials(self.mesh, Material(1e3, ratio, 1e3))
        softer = materials.young_modulus * np.exp((z.min() - z) / height)
        materials, nothing = replace(materials, young_modulus=softer), np.zeros(0, dtype=np.int32)
        newton = Newton(TissueModel(self.mesh, materials, self.fixed, Sphere(0.03), nothing))
        newton.set_displacement(np.ascontiguousarray(self.harmonic.T))
        goal = _TOLERANCE * newton.residual_norm
        for _ in range(_MOST_STEPS):
            if newton.residual_norm <= goal:
                return newton.displacement.T.copy()
            newton.step(newton.iteration_limit)
        raise SolverError(
            f"no balance was found: the residual stays at {newton.residual_norm:.2g} N where "
            f"{goal:.2g} N is asked for; the faces move too far for the mesh"
        )

    def interpolate_field(self, field: Array, points: Array) -> Array:
        """Interpolate a nodal field (N, 3) m at points (P, 3) m: (P, 3) m."""
        return locate_points(self.mesh, points).interpolate(field[self.mesh.tetrahedra])


def _compute_rms(vectors: Array) -> float:
    """Compute the root mean square of vectors (B, 3) m, in micrometres."""
    return float(np.sqrt((vectors**2).sum(axis=1).mean())) / _MICRON


def predict_beads(file: Path, spacing: float) -> Iterator[dict[str, Any]]:
    """Fit on one side of the axis, on a coarse mesh; judge on the other, with ``spacing`` (m)."""
    places, moved = read_beads(file)
    depth = np.minimum(places - _LOWER, _UPPER - places).min(axis=1)
    near, side = abs(depth) < _BAND, places[:, 0] > _AXIS
    known, judged = (depth >= _BAND) & ~side, (depth >= _BAND) & side
    coarse, box = (PrescribedBox(places[near], moved[near], s) for s in (_FITTING_MESH, spacing))

    def compute_misfit(parameters: tuple[float, ...]) -> float:
        return _compute_rms(
            coarse.interpolate_field(coarse.find_equilibrium(*parameters), places[known])
            - moved[known]
        )

    uniform = min(product(_RATIOS), key=compute_misfit)
    graded = min(product(_RATIOS, _HEIGHTS), key=compute_misfit)
    fields = {
        "harmonic": box.harmonic,
        f"uniform, ν {uniform[0]:g}": box.find_equilibrium(*uniform),
        f"graded over {graded[1] / _MICRON:g} µm, ν {graded[0]:g}": box.find_equilibrium(*graded),
    }
    half = np.random.default_rng(1).permutation(len(places)) % 2 == 0
    noise = np.zeros_like(moved)
    for one, other in ((half, ~half), (~half, half)):
        noise[one] = fit_near(places[other], moved[other], places[one], _NEAREST) - moved[one]
    for low, high in [(0.0, 1.0), *pairwise(_LAYERS)]:
        some = judged & (places[:, 2] >= low) & (places[:, 2] < high)
        for model, field in fields.items():
            yield {
                "case": "all" if low == 0 else f"z {low / _MICRON:.0f} to {high / _MICRON:.0f} um",
                "quantity": f"rms error, {model}",
                "unit": "um",
                "measured": _compute_rms(moved[some]),
                "error": _compute_rms(box.interpolate_field(field, places[some]) - moved[some]),
                "floor": _compute_rms(noise[some]),
                "fitted_on": "" if model == "harmonic" else "beads inside, other side of the axis",
                "line": model,
                "x": (low + high) / 2 / _MICRON,
            }


def plan_hydrogel(folder: Path, quick: bool) -> list[Piece]:
    """Plan the prediction on one mesh, the coarser one in a quick run."""
    run = partial(predict_beads, folder / FILE, _FITTING_MESH if quick else _MESH)
    return [Piece({"study": "hydrogel"}, run)]


def report_hydrogel(rows: pd.DataFrame) -> tuple[str, dict[str, Place]]:
    """Report the errors of the beads, in all and by height."""
    whole, layers = rows[rows["case"] == "all"], rows[rows["case"] != "all"]
    floor = layers.assign(error=layers["floor"], line="noise").drop_duplicates("x")
    figure = draw_lines(
        *(pd.concat([layers, floor]), "x", "error", "Beads in a gel: error by height"),
        lines="line",
        labels={"x": "height above the glass, µm", "error": "root mean square error, µm"},
    )
    plain, best = (row for row in whole.iloc[1:].to_dict("records"))
    words = (
        f"Beads in an indented gel: `fem_nonlinear` is {plain['error']:.2f} µm off, and "
        f"{best['error']:.2f} µm if the gel softens upwards. The beads moved by "
        f"{best['measured']:.1f} µm; their positions are known to {best['floor']:.2f} µm."
    )
    table = whole[["line", "error", "floor"]].assign(ratio=whole["error"] / whole["floor"])
    table.columns = pd.Index(["model", "error, µm", "noise, µm", "ratio"])
    return words, {"hydrogel": figure, "hydrogel_models": table}
