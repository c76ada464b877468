"""A probe on an elastic surface of known compliance, solved to rounding.

By Newton's method: at every round the probe is replaced by its tangent planes where the nodes now
are, the linear complementarity problem between forces and gaps is solved exactly, and the nodes are
moved. On a curved probe the planes turn with them, which Anderson's
mixing of the last rounds takes into account (D. G. Anderson, Iterative procedures for nonlinear
integral equations, J. ACM 12, 1965), so that a few rounds bring the gaps below a nanometre.

>>> from us_sim.geometry.collider import Sphere
>>> springs = np.eye(3) / 50.0  # m/N, one node
>>> contact = CompliantContact(Sphere(0.03), np.zeros((1, 3)), 0.02, springs)
>>> contact.press_at(Pose(position=[0.0, 0.0, 0.01])), contact.forces.round(3)  # 10 mm on 50 N/m
(True, array([[0. , 0. , 0.5]]))
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.collider import Collider
from us_sim.geometry.collider_distance import rotate_vector, rotate_vector_back
from us_sim.geometry.pose import Pose
from us_sim.kernels import njit
from us_sim.tissue.contact.complementarity import solve_active, solve_by_pivoting
from us_sim.tissue.contact.probe_gap import pushes_only_forward, pushing_gap

_CLOSED = 1e-9
"""A gap up to this is closed, and so is one of a node this deep in the probe, m."""

_MIXED, _ROUNDS = 30, 250
"""Rounds that mix earlier ones, and rounds in all: the later ones take plain, shorter steps, which
converge more surely."""

_SHORT = 0.7  # length of a shorter step

_NEAR = 0.4
"""Gap, over the spacing, beyond which nodes are left out until the probe enters them."""

_AHEAD = 0.25
"""Gap, over the spacing, beyond which open nodes are not solved for before the next round."""

_MEMORY = 4  # how many earlier rounds are mixed

_SLIDING = 1e-7
"""The normals have converged when the force along the surface over the contact force is below
this."""

_SKIRT = 0.25
"""Fraction of the spacing by which a pushed node must be beside the probe to be let go; it grows
each time that the node comes back. A node at the rim that is pressed down moves sideways; let go at
once, it would come up, get under the probe again, and so on without end."""


class CompliantContact:
    """Forces of a frictionless probe on surface nodes.

    Args:
        collider: the probe's shape.
        rest: (S, 3) m, rest positions of the nodes that it can touch, frame ``patient``.
        spacing: m, between neighbours among them.
        compliance: (3S, 3S) m/N, displacement 3 s + axis of force 3 t + axis.
    """

    def __init__(
        self,
        collider: Collider,
        rest: NDArray[np.float64],
        spacing: float,
        compliance: NDArray[np.float64],
    ) -> None:
        self._box = collider.offset_box
        self._forward = pushes_only_forward(collider, spacing)
        self._rest = np.ascontiguousarray(rest)
        self._spacing = spacing
        # Read-only always, since numba would compile the kernels again for what was just made.
        self._compliance = compliance.view()
        self._compliance.flags.writeable = False
        self.forces = np.zeros((len(rest), 3))  # (S, 3), N, of the probe on the tissue
        self.displacement = np.zeros((len(rest), 3))  # (S, 3), m; exact at `near` nodes
        self.near = np.zeros(len(rest), dtype=bool)  # (S,), nodes that the last press considered
        self.sliding_force = 0.0  # N, norm of the forces along the surface at pushed nodes

    def clear(self) -> None:
        """Take the probe away."""
        self.forces[:] = 0.0
        self.displacement[:] = 0.0
        self.near[:] = False
        self.sliding_force = 0.0

    def press_at(self, pose: Pose) -> bool:
        """Find the forces of the probe at a pose, starting from the last ones.

        Only nodes near the probe are considered; `add_overlooked` finds any others.

        Returns:
            Whether all gaps are closed or open as they should be, to a nanometre.
        """
        gap = self._measure_gaps(pose)
        self.near = (gap < _NEAR * self._spacing) | self.forces.any(axis=1)
        return self.solve(pose)

    def add_overlooked(self, pose: Pose, displacement: NDArray[np.float64]) -> bool:
        """Consider entered nodes that the last solution left out; return whether there are any.

        Args:
            pose: of the probe.
            displacement: (S, 3) m, of all nodes under the forces found.
        """
        self.displacement[~self.near] = displacement[~self.near]
        entered = (self._measure_gaps(pose) < -_CLOSED) & ~self.near
        self.near |= entered
        return bool(entered.any())

    def _measure_gaps(self, pose: Pose) -> NDArray[np.float64]:
        gap = np.empty(len(self._rest))
        normal = np.empty_like(self._rest)
        skirt = np.where(self.forces.any(axis=1), _SKIRT * self._spacing, 0.0)
        everyone = np.arange(len(self._rest))
        _fill_gaps(
            self._box,
            self._forward,
            pose.rotation,
            np.array(pose.position),
            self._rest,
            everyone,
            self.displacement,
            skirt,
            gap,
            normal,
        )
        return gap

    def solve(self, pose: Pose) -> bool:
        """Find the forces on the nodes considered so far; return as `press_at`."""
        near = np.flatnonzero(self.near)
        displacement = self.displacement[near]
        forces = self.forces[near]
        converged, self.sliding_force = _newton(
            self._box,
            self._forward,
            pose.rotation,
            np.array(pose.position),
            self._rest,
            self._spacing,
            self._compliance,
            near,
            displacement,
            forces,
        )
        self.forces[:] = 0.0
        self.forces[near] = forces
        self.displacement[near] = displacement
        return bool(converged)


@njit(cache=True, nogil=True, error_model="numpy")
def _gather(compliance, near):
    """Return (3k, 3k) m/N, the compliance between the nodes ``near`` (k,)."""
    k = len(near)
    block = np.empty((3 * k, 3 * k))
    for m in range(k):
        for axis in range(3):
            row = compliance[3 * near[m] + axis]
            for n in range(k):
                for other in range(3):
                    block[3 * m + axis, 3 * n + other] = row[3 * near[n] + other]
    return block


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_gaps(  # noqa: PLR0913
    box, forward, rotation, origin, rest, index, displacement, skirt, gap, normal
):
    """Fill gap (k,) and normal (k, 3) of the nodes ``index`` of rest, displaced by (k, 3)."""
    r = rotation
    for m in range(len(index)):
        i = index[m]
        a = rest[i, 0] + displacement[m, 0] - origin[0]
        b = rest[i, 1] + displacement[m, 1] - origin[1]
        c = rest[i, 2] + displacement[m, 2] - origin[2]
        x, y, z = rotate_vector_back(r, a, b, c)
        g, nx, ny, nz = pushing_gap(box, forward, skirt[m], x, y, z)
        gap[m] = g
        normal[m, 0], normal[m, 1], normal[m, 2] = rotate_vector(r, nx, ny, nz)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _newton(  # noqa: PLR0913
    box, forward, rotation, origin, rest, spacing, compliance, near, displacement, forces
):
    """Find displacement (k, 3) and forces (k, 3) of the nodes ``near``, which come in as a guess.

    Returns:
        Whether it converged, and the norm of the forces along the surface.
    """
    k = len(near)
    block = _gather(compliance, near)
    gap, normal = np.empty(k), np.empty((k, 3))
    active = (forces[:, 0] != 0.0) | (forces[:, 1] != 0.0) | (forces[:, 2] != 0.0)
    joined = active.astype(np.int64)  # how often each node has come to be pushed
    skirt = _SKIRT * joined * spacing
    point = displacement.copy()  # where the planes touch the probe
    last_point, last_step = point, point
    points, steps = np.empty((_MEMORY, k, 3)), np.empty((_MEMORY, k, 3))
    remembered = 0
    converged, sliding = False, 0.0
    for iteration in range(_ROUNDS):
        _fill_gaps(box, forward, rotation, origin, rest, near, point, skirt, gap, normal)
        was = active.copy()
        _solve_planes(block, point, gap, normal, _AHEAD * spacing, iteration == 0, active, forces)
        same = iteration > 0
        for m in range(k):
            if active[m] != was[m]:
                same = False
                if active[m]:
                    joined[m] += 1
                    skirt[m] = _SKIRT * joined[m] * spacing
        _displace(block, active, forces, displacement)
        step = displacement - point
        _fill_gaps(box, forward, rotation, origin, rest, near, displacement, skirt, gap, normal)
        converged, sliding = _check(gap, normal, active, forces)
        if converged or iteration == _ROUNDS - 1:
            break
        if same:
            slot = remembered % _MEMORY
            points[slot] = point - last_point
            steps[slot] = step - last_step
            remembered += 1
        else:
            remembered = 0
        if iteration >= _MIXED:
            point += _SHORT * step
            continue
        last_point, last_step = point.copy(), step
        _mix(active, step, points, steps, min(remembered, _MEMORY), point)
    return converged, sliding


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _solve_planes(block, point, gap, normal, limit, first, active, forces):
    """Solve the contact with the probe's tangent planes for active (k,) and forces (k, 3).

    The planes touch the probe where nodes are displaced by ``point`` (k, 3); there gaps are (k,)
    and normals (k, 3). ``active`` comes in as a guess.
    """
    k = len(gap)
    chosen = np.flatnonzero((gap < limit) | (active & np.isfinite(gap)))
    count = len(chosen)
    delassus = np.empty((count, count))
    offset, push, guess = np.empty(count), np.zeros(count), np.empty(count, np.bool_)
    for p in range(count):
        m = chosen[p]
        x, y, z = normal[m, 0], normal[m, 1], normal[m, 2]
        offset[p] = gap[m] - (x * point[m, 0] + y * point[m, 1] + z * point[m, 2])
        guess[p] = active[m] or (first and gap[m] < 0.0)
        a, b, c = block[3 * m], block[3 * m + 1], block[3 * m + 2]
        for q in range(p + 1):
            n = chosen[q]
            value = 0.0
            for axis in range(3):
                j = 3 * n + axis
                value += (x * a[j] + y * b[j] + z * c[j]) * normal[n, axis]
            delassus[p, q] = value
            delassus[q, p] = value
    if count > 0:
        solve_by_pivoting(delassus, offset, push, guess)
    for m in range(k):
        active[m] = False
        forces[m, 0] = forces[m, 1] = forces[m, 2] = 0.0
    for p in range(count):
        m = chosen[p]
        active[m] = push[p] > 0.0
        for axis in range(3):
            forces[m, axis] = push[p] * normal[m, axis]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _displace(block, active, forces, displacement):
    """Fill displacement (k, 3) that forces (k, 3) at active nodes cause."""
    load = np.zeros(len(block))
    for m in np.flatnonzero(active):
        for axis in range(3):
            load[3 * m + axis] = forces[m, axis]
    for i in range(len(block)):
        row = block[i]
        value = 0.0
        for j in range(len(load)):  # reading zeros in line is faster than skipping them
            value += row[j] * load[j]
        displacement[i // 3, i % 3] = value


@njit(cache=True, nogil=True, error_model="numpy")
def _check(gap, normal, active, forces):
    """Return whether gaps and normals have converged, and the norm of forces along the surface."""
    fits = True
    load, sliding = 0.0, 0.0
    for m in range(len(gap)):
        if not active[m]:
            fits &= gap[m] >= -_CLOSED
            continue
        fits &= abs(gap[m]) <= _CLOSED
        along = 0.0
        for axis in range(3):
            along += forces[m, axis] * normal[m, axis]
        for axis in range(3):
            load += forces[m, axis] ** 2
            sliding += (forces[m, axis] - along * normal[m, axis]) ** 2
    return fits and sliding <= _SLIDING**2 * load, np.sqrt(sliding)


@njit(cache=True, nogil=True, error_model="numpy")
def _mix(active, step, points, steps, count, point):
    """Move point (k, 3) by its step, less the part that the last changes explain (Anderson)."""
    gram = np.zeros((count, count))
    weight = np.zeros(count)
    for m in range(len(active)):
        if active[m]:
            for axis in range(3):
                for a in range(count):
                    weight[a] += steps[a, m, axis] * step[m, axis]
                    for b in range(count):
                        gram[a, b] += steps[a, m, axis] * steps[b, m, axis]
    everyone = np.arange(count)
    coefficient = np.zeros(count)
    if count > 0:
        solve_active(gram, weight, everyone, count, np.empty((count, count)), coefficient)
    for m in range(len(active)):
        for axis in range(3):
            value = step[m, axis]
            for a in range(count):
                value -= coefficient[a] * (points[a, m, axis] + steps[a, m, axis])
            point[m, axis] += value
