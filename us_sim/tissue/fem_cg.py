"""The paper's finite element method: linear strain, a few conjugate-gradient iterations a frame.

Quasi-static: every frame goes on from the last one's displacement towards K u = f, where the only
load is a frictionless probe that may push and not pull. The nodes it pushes lie on its surface:
their displacement along the normal is prescribed and projected out of the search space, as in
D. Baraff and A. Witkin, Large Steps in Cloth Simulation, SIGGRAPH 1998, section 5.

>>> import numpy as np
>>> from us_sim.collider import Sphere
>>> from us_sim.pose import Pose
>>> from us_sim.tissue.box import face_nodes
>>> from us_sim.tissue.fem_cg import FemCg
>>> from us_sim.tissue.materials import Material, uniform_material
>>> from us_sim.tissue.mesh import box_mesh, uniform_planes
>>> from us_sim.tissue.model import TissueModel
>>> across, deep = uniform_planes(-0.05, 0.05, 6), uniform_planes(0.0, 0.1, 6)
>>> mesh = box_mesh(across, across, deep)
>>> fixed = np.isin(np.arange(len(mesh.nodes)), face_nodes(mesh, "bottom"))
>>> materials = uniform_material(mesh, Material(10e3, 0.45, 1000.0))
>>> solver = FemCg(TissueModel(mesh, materials, fixed, Sphere(0.03), face_nodes(mesh, "top")))
>>> for _ in range(20):
...     deformation = solver.deform(Pose(position=[0.0, 0.0, 0.01]))
>>> deformation.residual < 1e-6, bool(deformation.nodes[:, 2].min() > -0.01)
(True, True)
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from numba import njit

from us_sim.errors import SolverError
from us_sim.pose import Pose
from us_sim.tissue.active_set import ActiveSet
from us_sim.tissue.contact import wrench_on_probe
from us_sim.tissue.deformation import Deformation, TissueState
from us_sim.tissue.elasticity import free_stiffness, require_held, stiffness
from us_sim.tissue.model import TissueModel
from us_sim.tissue.solver import TissueSolver

__all__ = ["FemCg"]

# How far the residual must fall before touched nodes that slid a little are corrected again.
_REFINEMENT = 1e-2


class FemCg(TissueSolver):
    """Linear elasticity by preconditioned conjugate gradients with warm start.

    The residual is the norm of the unbalanced nodal forces (those on free nodes, those along the
    probe's surface on touched nodes, and any with which the probe would have to pull) over the norm
    of the contact forces; after a release, over the last contact forces there were.

    Args:
        model: at least three fixed nodes that are not on one line in every connected part.
        iterations: of the conjugate gradients in a frame (the paper's 20).
        tolerance: residual at which a frame stops early.
        contact_updates: how often in a frame the set of touched nodes is revised.

    Raises:
        SolverError: a setting is out of range, or the tissue is not held.
    """

    name: ClassVar[str] = "fem_cg"

    def __init__(
        self,
        model: TissueModel,
        *,
        iterations: int = 20,
        tolerance: float = 1e-6,
        contact_updates: int = 3,
    ) -> None:
        for setting, value in (("iterations", iterations), ("contact_updates", contact_updates)):
            if not (isinstance(value, int) and 1 <= value <= 10_000):
                raise SolverError(f"fem_cg.{setting} is {value!r}: give an integer from 1 to 10000")
        if not 0 < tolerance < 1:
            raise SolverError(f"fem_cg.tolerance is {tolerance!r}: give a number between 0 and 1")
        require_held(model.mesh, model.fixed)
        super().__init__(model)
        self._tolerance = tolerance
        updates = min(contact_updates, iterations)
        self._rounds = np.diff(np.linspace(0, iterations, updates + 1).round().astype(int))

        free = ~model.fixed
        matrix = free_stiffness(stiffness(model.mesh, model.materials), model.fixed)
        self._free = np.flatnonzero(free)
        self._matrix = (matrix.indptr, matrix.indices, matrix.data)
        rows = np.repeat(np.arange(len(self._free)), np.diff(matrix.indptr))
        self._inverse = np.linalg.inv(matrix.data[rows == matrix.indices])
        touchable = model.movable_contact_nodes
        self._touchable = (np.cumsum(free) - 1)[touchable]
        self._contact = ActiveSet(
            model.collider, model.mesh.nodes[touchable], model.contact_spacing
        )

        self._displacement = np.zeros((len(self._free), 3))
        self._residual = np.zeros_like(self._displacement)
        self._direction = np.zeros_like(self._displacement)
        self._product = np.zeros_like(self._displacement)
        self._restore(self.state)

    @property
    def state(self) -> TissueState:
        """Where the tissue is; a quasi-static solver has no velocity."""
        state = TissueState.at_rest(len(self.model.mesh.nodes))
        state.displacement[self._free] = self._displacement
        return state

    def _restore(self, state: TissueState) -> None:
        self._displacement[:] = state.displacement[self._free]
        self._contact.clear()
        self._renew_equations()
        self._load = 0.0
        self._taken_over = bool(self._displacement.any())

    def _renew_equations(self) -> None:
        """Constrain the preconditioner to the touched nodes' tangents, and search anew."""
        touched = self._contact.touched
        self._touched = self._touchable[touched]
        self._normal = self._contact.normal[touched]
        self._preconditioner = self._inverse.copy()
        along = np.einsum("nij,nj->ni", self._inverse[self._touched], self._normal)
        compliance = np.einsum("ni,ni->n", along, self._normal)
        self._preconditioner[self._touched] -= (
            along[:, :, None] * along[:, None, :] / compliance[:, None, None]
        )
        self._slope = -1.0
        self._norm, self._refine_at = math.inf, 0.0

    def _advance(self, pose: Pose | None) -> Deformation:
        contact, displacement = self._contact, self._displacement
        if self._taken_over and pose is not None:
            contact.adopt(pose, displacement[self._touchable])
            self._renew_equations()
        self._taken_over = False
        for iterations in self._rounds:
            surface = displacement[self._touchable]
            if contact.revise(pose, surface, exactly=self._norm <= self._refine_at):
                displacement[self._touchable] = surface
                self._renew_equations()
            anew = self._slope < 0.0
            self._slope, before, self._norm = _conjugate_gradients(
                *self._matrix,
                self._preconditioner,
                self._touched,
                self._normal,
                displacement,
                self._residual,
                self._direction,
                self._product,
                self._slope,
                self._norm,
                iterations,
                0.5 * self._tolerance * self._load,
            )
            if anew:
                self._refine_at = _REFINEMENT * before
            contact.weigh(_product_rows(*self._matrix, displacement, self._touchable))
            self._load = float(np.linalg.norm(np.maximum(contact.push, 0.0))) or self._load
        return self._outcome(pose)

    def _outcome(self, pose: Pose | None) -> Deformation:
        contact, displacement = self._contact, self._displacement
        everywhere = np.arange(len(self._free), dtype=self._touchable.dtype)
        unbalanced = _product_rows(*self._matrix, displacement, everywhere)
        push = np.maximum(contact.push, 0.0)[:, None] * contact.normal
        unbalanced[self._touchable] -= push
        imbalance = float(np.linalg.norm(unbalanced))
        self._load = self._load or imbalance
        residual = imbalance / self._load if self._load else 0.0
        balanced = residual <= self._tolerance
        self._settled = balanced and contact.consistent(pose, displacement[self._touchable])
        if self._settled and not contact.touched.any():
            # Without a load the exact solution is the rest state.
            displacement[:] = 0.0
            residual = 0.0
        elif not balanced and self._slope == 0.0:
            # The updated residual has drifted from the true one.
            self._slope = -1.0
        nodes = self.model.mesh.nodes.copy()
        nodes[self._free] += displacement
        pushed = self.model.movable_contact_nodes[contact.push > 0]
        force, torque = np.zeros(3), np.zeros(3)
        if pose is not None:
            force, torque = wrench_on_probe(pose, nodes[pushed], push[contact.push > 0])
        return Deformation(nodes, pushed, force, torque, residual)


@njit(cache=True, nogil=True, error_model="numpy")
def _product_rows(start, columns, blocks, vector, rows):
    """(len(rows), 3) those block rows of the matrix times vector (N, 3)."""
    product = np.empty((len(rows), 3))
    for k in range(len(rows)):
        x = y = z = 0.0
        for b in range(start[rows[k]], start[rows[k] + 1]):
            v0 = vector[columns[b], 0]
            v1 = vector[columns[b], 1]
            v2 = vector[columns[b], 2]
            x += blocks[b, 0, 0] * v0 + blocks[b, 0, 1] * v1 + blocks[b, 0, 2] * v2
            y += blocks[b, 1, 0] * v0 + blocks[b, 1, 1] * v1 + blocks[b, 1, 2] * v2
            z += blocks[b, 2, 0] * v0 + blocks[b, 2, 1] * v1 + blocks[b, 2, 2] * v2
        product[k, 0] = x
        product[k, 1] = y
        product[k, 2] = z
    return product


@njit(cache=True, nogil=True, error_model="numpy")
def _project(vector, touched, normal):
    """Take the component along normal (T, 3) out of vector (N, 3) at the touched (T,) nodes."""
    for t in range(len(touched)):
        i = touched[t]
        along = (
            vector[i, 0] * normal[t, 0] + vector[i, 1] * normal[t, 1] + vector[i, 2] * normal[t, 2]
        )
        for axis in range(3):
            vector[i, axis] -= along * normal[t, axis]


@njit(cache=True, nogil=True, error_model="numpy")
def _multiply(start, columns, blocks, vector, product):
    """product (N, 3) = matrix in 3x3 blocks times vector (N, 3); returns vector . product."""
    energy = 0.0
    for i in range(len(vector)):
        x = y = z = 0.0
        for b in range(start[i], start[i + 1]):
            j = columns[b]
            v0 = vector[j, 0]
            v1 = vector[j, 1]
            v2 = vector[j, 2]
            x += blocks[b, 0, 0] * v0 + blocks[b, 0, 1] * v1 + blocks[b, 0, 2] * v2
            y += blocks[b, 1, 0] * v0 + blocks[b, 1, 1] * v1 + blocks[b, 1, 2] * v2
            z += blocks[b, 2, 0] * v0 + blocks[b, 2, 1] * v1 + blocks[b, 2, 2] * v2
        product[i, 0] = x
        product[i, 1] = y
        product[i, 2] = z
        energy += x * vector[i, 0] + y * vector[i, 1] + z * vector[i, 2]
    return energy


@njit(cache=True, nogil=True, error_model="numpy")
def _precondition(preconditioner, residual, scaled):
    """scaled (N, 3) = preconditioner (N, 3, 3) times residual (N, 3); returns r.z and r.r."""
    slope = 0.0
    square = 0.0
    for i in range(len(residual)):
        x = residual[i, 0]
        y = residual[i, 1]
        z = residual[i, 2]
        m = preconditioner[i]
        a = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z
        b = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z
        c = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z
        scaled[i, 0] = a
        scaled[i, 1] = b
        scaled[i, 2] = c
        slope += a * x + b * y + c * z
        square += x * x + y * y + z * z
    return slope, square


@njit(cache=True, nogil=True, error_model="numpy")
def _conjugate_gradients(
    start,
    columns,
    blocks,
    preconditioner,
    touched,
    normal,
    displacement,
    residual,
    direction,
    product,
    slope,
    norm,
    iterations,
    target,
):
    """Improve displacement (N, 3) by at most ``iterations``, until |residual| <= target.

    Goes on with residual and direction when ``slope`` is positive, begins anew when it is negative,
    and does nothing when it is 0; ``norm`` is then |residual|.

    Returns:
        The slope to go on with (0 when converged), and |residual| before and after.
    """
    if slope < 0.0:
        _multiply(start, columns, blocks, displacement, residual)
        for i in range(len(residual)):
            for axis in range(3):
                residual[i, axis] = -residual[i, axis]
        _project(residual, touched, normal)
        slope, square = _precondition(preconditioner, residual, direction)
        norm = math.sqrt(square)
    before = norm
    if norm <= target or slope == 0.0:
        return 0.0, before, norm
    for _ in range(iterations):
        energy = _multiply(start, columns, blocks, direction, product)
        if not energy > 0.0:
            return -1.0, before, norm
        _project(product, touched, normal)
        step = slope / energy
        for i in range(len(displacement)):
            for axis in range(3):
                displacement[i, axis] += step * direction[i, axis]
                residual[i, axis] -= step * product[i, axis]
        last = slope
        slope, square = _precondition(preconditioner, residual, product)
        norm = math.sqrt(square)
        if norm <= target:
            return 0.0, before, norm
        turn = slope / last
        for i in range(len(direction)):
            for axis in range(3):
                direction[i, axis] = product[i, axis] + turn * direction[i, axis]
    return slope, before, norm
