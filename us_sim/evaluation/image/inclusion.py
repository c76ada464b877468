"""A block with a stiff ball in it under a plate: as the simulator deforms it, and as it should be.

The reference is Hooke's law on quadratic tetrahedra, assembled by scikit-fem and solved by SciPy,
for a quarter of the block, on planes that are close together around the ball.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import dia_array

from us_sim.evaluation.block import EXTENT, MESHES
from us_sim.evaluation.solved import solved
from us_sim.evaluation.tissue.graded_planes import graded_planes
from us_sim.geometry.collider import RoundedBox
from us_sim.geometry.pose import Pose
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import average_over_labels, label_fractions
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh, box_mesh
from us_sim.tissue.model import TissueModel, face_nodes
from us_sim.tissue.solvers.solver import TissueSolver, create_solver
from us_sim.volume.volume import Volume

PLATE = RoundedBox(length=0.4, width=0.3, height=0.05, rounding=0.001)
"""Larger than the block's top."""

_ITERATIONS = 20_000


@dataclass(frozen=True)
class Ball:
    """A ball that is stiffer than what is around it."""

    centre: tuple[float, float, float] = (0.0, 0.0, 0.045)  # m
    radius: float = 0.018  # m
    stiffer: float = 3.0
    poisson_ratio: float = 0.45  # of both

    def holds(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which of points (…, 3) m lie in it."""
        return np.asarray(np.linalg.norm(points - np.array(self.centre), axis=-1) <= self.radius)


def plate_model(
    mesh: TetrahedralMesh, soft: Material, stiff: Material, labels: Volume
) -> TissueModel:
    """The block on a floor that holds it, below a plate; label 2 is the stiff material."""
    assert labels.labels is not None
    fractions = label_fractions(mesh, labels.labels, labels.patient_to_index)
    return TissueModel(
        mesh=mesh,
        materials=average_over_labels(fractions, {1: soft, 2: stiff}),
        fixed=np.isin(np.arange(len(mesh.nodes)), face_nodes(mesh, "bottom")),
        collider=PLATE,
        contact_nodes=face_nodes(mesh, "top"),
    )


def pressed_by_plate(solver: TissueSolver, depth: float) -> NDArray[np.float64]:
    """(N, 3) m, the nodes with the plate ``depth`` m below the top, once nothing moves."""
    pose = Pose(np.array([0.0, 0.0, depth]))
    for _ in range(200):
        deformation = solver.deform(pose)
        if solver.deform(pose) is deformation:
            break
    return deformation.nodes


def labelled(ball: Ball | None) -> Volume:
    """The block without echoes in voxels of 1 mm: label 2 in the ball, 1 elsewhere."""
    low, high = np.array(EXTENT).T
    counts = np.rint((high - low) / 1e-3).astype(int)
    to_patient = np.diag([1e-3, 1e-3, 1e-3, 1.0])
    to_patient[:3, 3] = low + 0.5e-3
    labels = np.ones(counts, dtype=np.uint8)
    if ball is not None:
        places = np.moveaxis(np.indices(counts), 0, -1) * 1e-3 + to_patient[:3, 3]
        labels[ball.holds(places)] = 2
    names = {1: "soft", 2: "stiff"}
    return Volume(np.zeros(counts, np.uint8), to_patient, labels, names)


@cache
def ball_mesh(ball: Ball) -> TetrahedralMesh:
    """As many tetrahedra as the finest of the paper's meshes, with planes closer in the ball."""
    half = ball.radius + 0.5e-3
    planes: list[NDArray[np.float64]] = []
    for (low, high), centre, count in zip(EXTENT, ball.centre, (15, 9, 9), strict=True):
        fine = np.linspace(centre - half, centre + half, count + 1)
        outside = (MESHES[-1][len(planes)] - count - 1) // 2
        size = 2.0 * half / count
        planes.append(
            np.concatenate(
                [
                    fine[0] - _growing(fine[0] - low, size, outside)[::-1],
                    fine,
                    fine[-1] + _growing(high - fine[-1], size, outside),
                ]
            )
        )
        planes[-1][[0, -1]] = low, high
    return box_mesh(*planes)


def _growing(length: float, size: float, count: int) -> NDArray[np.float64]:
    """Where planes lie whose distances grow from ``size`` on and fill a length, by bisection."""
    least, most = 0.1, 10.0
    for _ in range(60):
        growth = (least * most) ** 0.5
        far = size * (growth ** np.arange(1, count + 1)).sum() > length
        least, most = (least, growth) if far else (growth, most)
    return np.asarray(size * np.cumsum(growth ** np.arange(1, count + 1)))


@cache
def ball_nodes(ball: Ball, depth: float) -> NDArray[np.float64]:
    """(N, 3) m, of that mesh with the ball in it, under the plate."""
    return pressed_by_plate(_ball_solver(ball), depth)


@cache
def _ball_solver(ball: Ball) -> TissueSolver:
    soft = Material(10e3, ball.poisson_ratio, 1000.0)
    stiff = Material(10e3 * ball.stiffer, ball.poisson_ratio, 1000.0)
    return create_solver("fem", plate_model(ball_mesh(ball), soft, stiff, labelled(ball)))


class Reference:
    """The linear solution on a fine mesh, for a unit of depth.

    Args:
        ball: what is in the block.
        size: m, between planes around the ball.

    Raises:
        SolverError: SciPy's conjugate gradients did not converge.
    """

    def __init__(self, ball: Ball, size: float) -> None:
        from skfem import Basis, BilinearForm, ElementTetP2, ElementVector, MeshTet
        from skfem.helpers import ddot, div, sym_grad

        (_, across), (_, along), (_, deep) = EXTENT
        near = ball.radius + size
        z = ball.centre[2]
        mesh = box_mesh(
            graded_planes(0.0, across, 0.0, near, size, 1.5),
            graded_planes(0.0, along, 0.0, near, size, 1.5),
            graded_planes(0.0, deep, z - near, z + near, size, 1.5),
        )
        self._mesh = MeshTet(*map(np.ascontiguousarray, (mesh.nodes.T, mesh.tetrahedra.T)))
        self._basis = Basis(self._mesh, ElementVector(ElementTetP2()))
        ratio = ball.poisson_ratio

        @BilinearForm
        def elasticity(u, v, w):  # type: ignore[no-untyped-def]
            young = np.where(ball.holds(np.moveaxis(w.x, 0, -1)), ball.stiffer, 1.0)
            shear = 0.5 * young / (1.0 + ratio)
            bulk = young * ratio / ((1.0 + ratio) * (1.0 - 2.0 * ratio))
            return 2.0 * shear * ddot(sym_grad(u), sym_grad(v)) + bulk * div(u) * div(v)

        matrix = elasticity.assemble(self._basis).tocsr()
        # Of a quarter: nothing crosses the planes of symmetry; the floor holds, the plate slides.
        held = np.unique(
            np.concatenate(
                [
                    self._on(0, 0.0, "u^1"),
                    self._on(1, 0.0, "u^2"),
                    *(self._on(2, deep, component) for component in ("u^1", "u^2", "u^3")),
                ]
            )
        )
        top = self._on(2, 0.0, "u^3")
        self._unit = np.zeros(matrix.shape[0])
        self._unit[top] = 1.0
        free = np.setdiff1d(np.arange(matrix.shape[0]), np.concatenate([held, top]))
        inner = matrix[free][:, free]
        right = -(matrix @ self._unit)[free]
        over = dia_array((1.0 / inner.diagonal()[None], [0]), shape=inner.shape)
        self._unit[free] = solved(inner, right, 1e-8, over, _ITERATIONS)

    def gradient(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(P, 3, 3) the displacement's gradient per m of depth, at points (P, 3) m at rest."""
        signs = np.where(points[:, :2] < 0.0, -1.0, 1.0)
        mirror = np.column_stack([signs, np.ones(len(points))])
        places = (points * mirror).T
        cells = self._mesh.element_finder()(*places)
        local = self._mesh.mapping().invF(places[:, :, None], tind=cells)
        gradient = np.zeros((len(points), 3, 3))
        for i in range(self._basis.Nbfun):
            field = self._basis.elem.gbasis(self._basis.mapping, local, i, tind=cells)[0]
            weight = self._unit[self._basis.element_dofs[i, cells]]
            gradient += weight[:, None, None] * np.moveaxis(field.grad[..., 0], -1, 0)
        return gradient * mirror[:, :, None] * mirror[:, None, :]

    def _on(self, axis: int, place: float, component: str) -> NDArray[np.intp]:
        facets = self._mesh.facets_satisfying(lambda x: np.isclose(x[axis], place))
        return np.asarray(self._basis.get_dofs(facets).all(component))
