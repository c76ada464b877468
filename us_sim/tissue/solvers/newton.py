"""Newton's method for tissue held on the probe: no step is taken that makes matters worse.

>>> import numpy as np
>>> from us_sim.geometry.collider import RoundedBox
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tissue.elasticity.material import Material
>>> from us_sim.tissue.elasticity.materials import uniform_material
>>> from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
>>> from us_sim.tissue.model import TissueModel
>>> from us_sim.tissue.solvers.newton import Newton
>>> mesh = box_mesh(*[uniform_planes(0.0, 0.1, 4)] * 3)
>>> top, bottom = np.flatnonzero(mesh.nodes[:, 2] == 0), mesh.nodes[:, 2] == 0.1
>>> materials = uniform_material(mesh, Material(10e3, 0.3, 1000.0))
>>> newton = Newton(TissueModel(mesh, materials, bottom, RoundedBox(0.5, 0.5, 0.1, 0.01), top))
>>> newton.settle_on(Pose(position=[0.0, 0.0, 0.005]), 0.0)
>>> unbalanced = newton.imbalance
>>> for _ in range(4):
...     used, better = newton.step(Pose(position=[0.0, 0.0, 0.005]), 0.0, 20)
>>> newton.imbalance < 1e-3 * unbalanced
True
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Pose
from us_sim.tissue.contact.sliding_contact import SlidingContact
from us_sim.tissue.elasticity.neo_hookean import NeoHookean
from us_sim.tissue.linear_algebra.coarse_grid import CoarseGrid
from us_sim.tissue.linear_algebra.projected_conjugate_gradients import (
    Constraints,
    apply_blocks,
    inverse_blocks,
    project,
    projected_conjugate_gradients,
)
from us_sim.tissue.model import TissueModel

__all__ = ["Newton"]

_SINGLE_CONTRAST = 1e4
"""Ratio of Young's moduli beyond which rounding in single precision hides the softer forces."""

_SINGLE_BULK = 1e3
"""Bulk over shear modulus beyond which rounding in single precision hides the shear's forces."""

_BACKTRACKS = 6
"""Step lengths that are tried, each half the last."""

_CROWDED = 0.2
"""Volume ratio of the most compressed tetrahedron below which steps use a tangent without negative
eigenvalues, since those of the exact tangent overshoot; above it those of the former fall short."""

_FORCING = 1e-2
"""Fraction to which a step lowers the preconditioned residual. Lower is no use: the next step has a
new tangent."""

_LOCAL_WEIGHT = 4.0
"""Weight of the local preconditioner, over the largest eigenvalue of the locally preconditioned
stiffness at rest; 1 to 6 were tried."""

_POWER = 20
"""Power iterations towards the largest eigenvalue of the locally preconditioned stiffness."""


@dataclass(frozen=True, eq=False)
class _Snapshot:
    displacement: NDArray[np.float64]
    force: NDArray[np.float64]
    contact: SlidingContact
    imbalance: float
    load: float


class Newton:
    """A state of the tissue, the forces in it, and steps towards their balance.

    Args:
        model: with at least one movable contact node.
    """

    def __init__(self, model: TissueModel) -> None:
        mesh, modulus = model.mesh, model.materials.young_modulus
        bulk = 1 / (1 - 2 * model.materials.poisson_ratio.max())  # lambda + mu over mu
        single = modulus.max() <= _SINGLE_CONTRAST * modulus.min() and bulk <= _SINGLE_BULK
        self._dtype: type[np.floating] = np.float32 if single else np.float64
        self.tissue = NeoHookean(mesh, model.materials, np.float64)
        # Conjugate gradients only correct; what they correct is in double precision.
        self._tangent = NeoHookean(mesh, model.materials, self._dtype)
        self._fixed = np.flatnonzero(model.fixed)
        self._surface = model.movable_contact_nodes
        self._surface_rest = mesh.nodes[self._surface]
        self._grid = CoarseGrid(mesh, model.fixed, self.tissue.tangent_product, self._dtype)
        # As they are at rest: the deformed ones, computed anew at each step, save no iterations.
        self._blocks: NDArray[np.floating] = self.tissue.diagonal_blocks().astype(self._dtype)
        self._local_scale = self._local_weight()
        shape = (3, len(mesh.nodes))
        self._solution = np.empty(shape, self._dtype)
        self._balance = np.empty(shape)
        self.contact = SlidingContact(model.collider, model.contact_spacing)
        self.displacement = np.zeros(shape)  # m
        self.force = np.zeros(shape)  # N, what holds each node where it is
        self.rest()

    def rest(self) -> None:
        """Put the tissue to rest: undeformed, and touched nowhere."""
        self.displacement = np.zeros_like(self.displacement)
        self.force = np.zeros_like(self.force)
        self.contact.clear(len(self._surface))
        self.imbalance = 0.0  # N, norm of the unbalanced forces
        self.load = 0.0  # N, norm of the contact forces

    def snapshot(self) -> _Snapshot:
        """A copy of the state for `restore`."""
        return _Snapshot(
            self.displacement.copy(),
            self.force.copy(),
            self.contact.copy(),
            self.imbalance,
            self.load,
        )

    def restore(self, snapshot: _Snapshot) -> None:
        """Go back to a snapshot."""
        self.displacement = snapshot.displacement.copy()
        self.force = snapshot.force.copy()
        self.contact = snapshot.contact.copy()
        self.imbalance, self.load = snapshot.imbalance, snapshot.load

    @property
    def surface(self) -> NDArray[np.float64]:
        """(C, 3) m, where the nodes are that the probe can touch."""
        return self._surface_rest + self.displacement[:, self._surface].T

    def settle_on(self, pose: Pose, retreat: float) -> None:
        """Move nodes that touch or have entered the probe onto it, and weigh the forces."""
        self.contact.aim(pose, retreat, self.surface)
        self._hold(pose, retreat)
        self._weigh()

    def weigh_on(self, pose: Pose) -> None:
        """Weigh the same forces against another pose's normals, moving nothing."""
        self.contact.aim(pose, 0.0, self.surface)
        self._weigh_contact()

    def step(self, pose: Pose, retreat: float, iterations: int) -> tuple[int, bool]:
        """One Newton step with a line search.

        Args:
            pose: of the probe, the one of the last `settle_on` or step.
            retreat: m, added to the gaps.
            iterations: the most of the conjugate gradients.

        Returns:
            The iterations used, and whether the step was taken; if not, nothing has changed.
        """
        contact = self.contact
        contact.release()
        touched = self._surface[contact.touched]
        normal = contact.normal[contact.touched]
        constraints = Constraints(self._fixed, touched, normal.astype(self._dtype))
        residual = (self.force * (-1.0 / (self.imbalance or 1.0))).astype(self._dtype)
        project(residual, constraints)
        crowded = not self.tissue.smallest_volume_ratio(self.displacement) > _CROWDED
        self._tangent.linearise(self.displacement.astype(self._dtype), positive=crowded)
        blocks = self._blocks
        turn = contact.curvature(pose, self.surface)
        turn = (turn * contact.push[contact.touched][:, None, None]).astype(self._dtype)

        def product(change: NDArray, image: NDArray) -> None:
            self._tangent.tangent_product(change, image)
            image[:, touched] -= np.einsum("kij,jk->ik", turn, change[:, touched])

        self._grid.touch(touched, normal, _along(blocks[:, touched], normal))
        inverse = inverse_blocks(blocks, self._local_scale, constraints)
        used, _ = projected_conjugate_gradients(
            product,
            inverse,
            self._grid.add_correction,
            constraints,
            residual,
            self._solution,
            iterations,
            _FORCING,
        )
        if self._search(pose, retreat, self._solution * np.float64(self.imbalance)):
            return used, True
        # Where its neighbours' move drives a released node back, its own force still leads on.
        own = -self.force
        project(own, constraints)
        return used, self._search(pose, retreat, apply_blocks(inverse, own))

    def _search(self, pose: Pose, retreat: float, change: NDArray[np.float64]) -> bool:
        """Move by the largest fraction of the change that lowers imbalance or energy."""
        before = self.snapshot()
        inverted = energy = None
        length = 1.0
        for _ in range(_BACKTRACKS):
            self.displacement = before.displacement + length * change
            self.contact = before.contact.copy()
            self._hold(pose, retreat)
            smallest = self.tissue.smallest_volume_ratio(self.displacement)
            if not smallest > 0.0 and inverted is None:
                inverted = self.tissue.inverted(before.displacement)
            if smallest > 0.0 or inverted:
                self._weigh()
                if self.imbalance < before.imbalance:
                    return True
                if energy is None:
                    energy = self.tissue.energy(before.displacement)
                if self.tissue.energy(self.displacement) < energy:
                    return True
            length /= 2
        self.restore(before)
        return False

    def _hold(self, pose: Pose, retreat: float) -> None:
        surface = self.surface
        self.contact.hold(pose, retreat, surface)
        self.displacement[:, self._surface] = (surface - self._surface_rest).T

    def _weigh(self) -> None:
        self.tissue.forces(self.displacement, self.force)
        self._weigh_contact()

    def _weigh_contact(self) -> None:
        np.copyto(self._balance, self.force)
        self._balance[:, self._fixed] = 0.0
        held = self.force[:, self._surface].T
        self._balance[:, self._surface] = self.contact.weigh(held).T
        self.imbalance = float(np.linalg.norm(self._balance))
        self.load = float(np.linalg.norm(np.maximum(self.contact.push, 0.0)))

    def _local_weight(self) -> float:
        """Weight of the local preconditioner; the coarse one beside it has weight 1."""
        none = np.zeros(0, np.int64)
        constraints = Constraints(self._fixed, none, np.zeros((0, 3)))
        inverse = inverse_blocks(self.tissue.diagonal_blocks(), 1.0, constraints)
        shape = (3, inverse.shape[1])
        vector = np.random.default_rng(0).standard_normal(shape)
        largest = 0.0
        for _ in range(_POWER):
            project(vector, constraints)
            largest = float(np.linalg.norm(vector))
            if largest == 0.0:
                return 1.0
            vector = apply_blocks(inverse, self.tissue.tangent_product(vector / largest))
        return _LOCAL_WEIGHT / largest


def _along(blocks: NDArray[np.floating], normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K,) n' D n of symmetric blocks (6, K) and normals (K, 3)."""
    x, y, z = normal.T
    xx, xy, xz, yy, yz, zz = blocks.astype(np.float64)
    return xx * x * x + yy * y * y + zz * z * z + 2 * (xy * x * y + xz * x * z + yz * y * z)
