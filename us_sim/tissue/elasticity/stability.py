"""Stability and residual of spring tissues: stable steps, inverted tetrahedra, unbalanced forces.

A mode of circular frequency w, damped by b times its stiffness, is multiplied in a symplectic Euler
step of dt by a root of z**2 - (2 - b w**2 dt - w**2 dt**2) z + 1 - b w**2 dt. Both roots are inside
the unit circle (E. I. Jury's conditions) if and only if dt**2 + 2 b dt < 4 / w**2.

Springs know lengths and not volumes: pressed beyond the mesh's spacing, a node can pass through a
face and then rests on the wrong side. Under the probe this is only reported; without a probe the
tissue is put back to its undeformed state, which is then the state of rest.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.linalg import LinearOperator, eigsh

from us_sim.errors import SolverError
from us_sim.kernels import njit
from us_sim.tissue.elasticity.springs import SpringNetwork
from us_sim.tissue.model import TissueModel

_MARGIN = 1.05  # Safety factor of masses and sub-steps on Gershgorin's bound of stability
_TOLERANCE = 1e-4  # relative, of the square of the highest frequency


def step_limit(frequency: float, damping_factor: float) -> float:
    """Return the longest stable step (s) of symplectic Euler for stiffness-proportional damping.

    Args:
        frequency: the highest one, 1/s.
        damping_factor: s, damping constant over stiffness.
    """
    span = 4 / frequency**2
    return span / (damping_factor + math.sqrt(damping_factor**2 + span))


def highest_frequency(
    factor: csr_array, mass: NDArray[np.float64], fixed: NDArray[np.bool_]
) -> float:
    """Return the largest circular frequency (1/s) of small undamped oscillations.

    By Lanczos iterations on the largest generalised eigenvalue of stiffness and mass, to 1e-4.

    Args:
        factor: B (rows, 3N), such that B'B is the stiffness.
        mass: (N,) kg.
        fixed: (N,), held nodes.
    """
    scale = np.repeat(np.where(fixed, 0.0, 1 / np.sqrt(mass)), 3)
    free = np.repeat(~fixed, 3)
    factor = csr_array(factor.multiply(scale).tocsc()[:, free])
    size = factor.shape[1]
    if size <= 30:
        return math.sqrt(max(np.linalg.eigvalsh((factor.T @ factor).toarray())[-1], 0.0))
    back = factor.T.tocsr()
    product = LinearOperator((size, size), matvec=lambda v: back @ (factor @ v), dtype=float)
    start = np.random.default_rng(0).standard_normal(size)
    largest = eigsh(product, k=1, which="LA", v0=start, tol=_TOLERANCE, return_eigenvectors=False)
    return math.sqrt(largest[0])


def bound_node_stiffness(factor: csr_array) -> NDArray[np.float64]:
    """Return (N,) N/m, d such that the stiffness is nowhere above 2 diag(d) (Gershgorin's bound).

    It is the sum of a node's spring constants, which holds however they turn and stretch, and about
    2.7 times the bound that the undeformed tissue needs.

    Args:
        factor: as in `highest_frequency`.
    """
    count = factor.shape[1] // 3
    axes = np.repeat(np.arange(count), 3), np.arange(3 * count)
    merge = csr_array((np.ones(3 * count), axes[::-1]), shape=(3 * count, count))
    size = csr_array(factor.multiply(factor) @ merge).sqrt()
    return np.asarray(0.5 * (size.T @ np.asarray(size.sum(axis=1)).ravel()))


def stabilise(
    model: TissueModel,
    factor: csr_array,
    time_step: float,
    damping_factor: float,
    stabilisation: str,
    maximum_substeps: int,
) -> tuple[NDArray[np.float64], int, str]:
    """Choose masses and sub-steps that make a step stable.

    They follow from `bound_node_stiffness`, so that the step stays stable as the tissue deforms.
    The limit in the remark is that of small oscillations.

    Args:
        model: whose lumped masses are simulated where possible.
        factor: as in `highest_frequency`.
        time_step: s, as set.
        damping_factor: s, damping constant over stiffness.
        stabilisation: ``mass_scaling``, ``substeps``, or ``none``, which only adds the remark.
        maximum_substeps: the most that are allowed.

    Returns:
        Masses (N,) kg, the number of sub-steps, and a remark on them.

    Raises:
        SolverError: more sub-steps than allowed.
    """
    mass, free = model.lumped_mass, ~model.fixed
    if not free.any():
        return mass, 1, ""
    stiffness = bound_node_stiffness(factor)
    span = time_step**2 + 2 * damping_factor * time_step
    needed = 0.5 * _MARGIN * span * stiffness
    if not (needed > mass)[free].any():
        return mass, 1, ""
    limit = step_limit(highest_frequency(factor, mass, model.fixed), damping_factor)
    unstable = f"steps beyond {1e3 * limit:.2g} ms are unstable"
    if stabilisation == "none":
        return mass, 1, unstable
    if stabilisation == "mass_scaling":
        scaled = np.maximum(mass, needed)
        raised = (scaled / mass)[free]
        low, high = raised.min(), raised.max()
        return scaled, 1, f"masses scaled {low:.0f} to {high:.0f} times: unscaled, {unstable}"
    bound = math.sqrt(2 * _MARGIN * (stiffness / mass)[free].max())
    substeps = math.ceil(time_step / step_limit(bound, damping_factor))
    if substeps > maximum_substeps:
        raise SolverError(
            f"msds needs {substeps} sub-steps for each step of {1e3 * time_step:g} ms, more than "
            f"maximum_substeps = {maximum_substeps}: use stabilisation mass_scaling, or lower "
            f"damping_factor"
        )
    return mass, substeps, f"{substeps} sub-steps a step: undivided, {unstable}"


# Tetrahedra up to which all are watched, which takes less than a millisecond; and how many layers
# under the surface are watched otherwise.
_WATCHED, _LAYERS = 50_000, 2
_FRAMES_TO_UNTANGLE = 10  # Frames in which a released tissue may untangle by itself


class InversionWatch:
    """Count of tetrahedra inside out, frame by frame."""

    def __init__(self, model: TissueModel) -> None:
        self._tetrahedra = model.mesh.tetrahedra
        self._held = bool(model.fixed.any())
        self._frames_free = 0

    def reset(self) -> None:
        """Begin anew, since the tissue was put elsewhere."""
        self._frames_free = 0

    def check_frame(self, positions: NDArray[np.float64], touched: bool) -> tuple[int, bool]:
        """Count tetrahedra inside out after a frame; decide whether to put the tissue to rest.

        Args:
            positions: (N, 3) m.
            touched: whether the probe touches the tissue.
        """
        self._frames_free = 0 if touched else self._frames_free + 1
        inverted = count_inverted(positions, self._tetrahedra)
        released = self._held and self._frames_free >= _FRAMES_TO_UNTANGLE
        return inverted, inverted > 0 and released


def select_watched_tetrahedra(model: TissueModel) -> NDArray[np.int32]:
    """Select the tetrahedra (W, 4) to watch: all, or in a large mesh those under the surface.

    A press turns those inside out first.
    """
    tetrahedra = model.mesh.tetrahedra
    if len(tetrahedra) <= _WATCHED:
        return tetrahedra
    near = np.zeros(len(model.mesh.nodes), dtype=bool)
    near[model.contact_nodes] = True
    for _ in range(_LAYERS):
        touched = near[tetrahedra].any(axis=1)
        near[tetrahedra[touched]] = True
    return np.ascontiguousarray(tetrahedra[touched])


@njit(cache=True, nogil=True, error_model="numpy")
def count_inverted(nodes, tetrahedra):
    """Count the tetrahedra (M, 4) without a positive volume."""
    count = 0
    for t in range(len(tetrahedra)):
        a, b, c, d = tetrahedra[t, 0], tetrahedra[t, 1], tetrahedra[t, 2], tetrahedra[t, 3]
        x, y, z = nodes[a, 0], nodes[a, 1], nodes[a, 2]
        bx, by, bz = nodes[b, 0] - x, nodes[b, 1] - y, nodes[b, 2] - z
        cx, cy, cz = nodes[c, 0] - x, nodes[c, 1] - y, nodes[c, 2] - z
        dx, dy, dz = nodes[d, 0] - x, nodes[d, 1] - y, nodes[d, 2] - z
        px, py, pz = cy * dz - cz * dy, cz * dx - cx * dz, cx * dy - cy * dx
        if not bx * px + by * py + bz * pz > 0.0:
            count += 1
    return count


class ElasticResidual:
    """Residual of each frame of a run.

    It is the norm of the unbalanced elastic forces over the norm of the contact forces, or, without
    contact, over the largest such norm since rest; it is 1 before the first. Inertia and damping do
    not count: it says how far the tissue is from where it would come to rest.

    Args:
        rounding: N, norm of the forces at rest that arise when coordinates are rounded.
    """

    def __init__(self, rounding: float) -> None:
        self._rounding = rounding
        self.largest_load = 0.0  # N, largest norm of contact forces since the tissue was at rest

    @classmethod
    def for_springs(cls, springs: SpringNetwork, nodes: NDArray[np.float64]) -> ElasticResidual:
        """Make the residual of springs that are undeformed at nodes (N, 3) m."""
        stiffness = float(np.linalg.norm(springs.stiffness))
        return cls(4 * float(np.finfo(np.float64).eps * np.abs(nodes).max()) * stiffness)

    def reset(self) -> None:
        """Begin anew, since the tissue was put elsewhere: earlier loads no longer count."""
        self.largest_load = 0.0

    def compute_residual(
        self,
        elastic: NDArray[np.float64],
        touched: NDArray[np.integer],
        normal: NDArray[np.float64],
    ) -> float:
        """Compute the residual of one frame.

        Args:
            elastic: (N, 3) N that would hold the nodes where they are, nothing at fixed ones.
            touched: (K,) nodes in contact.
            normal: (K, 3) unit directions of the contact forces.
        """
        contact_force = np.maximum(np.einsum("ij,ij->i", elastic[touched], normal), 0.0)
        unbalanced = elastic.copy()
        unbalanced[touched] -= contact_force[:, None] * normal
        unbalanced_norm = float(np.linalg.norm(unbalanced))
        load = float(np.linalg.norm(contact_force))
        if load == 0.0 and unbalanced_norm <= self._rounding:
            self.largest_load = 0.0
            return 0.0
        self.largest_load = max(self.largest_load, load)
        return unbalanced_norm / (load or self.largest_load or unbalanced_norm)
