"""Contact whose forces have an energy: springs between points of the surface and the probe.

Each point of the surface that the probe has entered is pushed out along the probe's normal by a
force that rises with its depth, faster and faster, and ends at a greatest one, as a hand cannot
push without end. With d = max(0, -gap) it is

    k d (1 + (d / d1)^2) up to F,    energy k d^2 / 2 + k d^4 / (4 d1^2), and on at the slope F.

So the state of tissue under a probe is a minimum of one energy that depends on the two alone, not
on how the probe came there (P. Wriggers, Computational Contact Mechanics, 2nd ed. 2006, section
5.1). The price is that the probe sinks in a little, as it does into gel.

A point inside a flat triangle is deeper in a round probe than tissue, which bends, would be there;
and at a probe's edge a triangle is pushed down as a whole, though only a part of it is below the
probe. Both are errors of linear interpolation. So springs know a gap that is larger than the
point's own, g(x), by the relief

    min(r (sum of w_i g(x_i) - g(x)), most),    x = sum of w_i x_i,

where x_i are the corners of the point's triangle. It is not negative, since the probe is convex,
and zero below a flat face. It is measured before each of Newton's steps, and stays during that.

>>> from us_sim.geometry.collider import Sphere
>>> probe = FlaredProbe(Sphere(0.03), spacing=0.01)
>>> contact = PenaltyContact(probe, np.array([1e4]), np.array([15.0]), stiffening=1e-3)
>>> contact.set_pose(Pose(position=[0.0, 0.0, 1e-4]), np.zeros((1, 3)))
>>> contact.normal_force.round(9), contact.normal
(array([1.01]), array([[0., 0., 1.]]))
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Pose
from us_sim.kernels import njit
from us_sim.tissue.contact.probe_gap import FlaredProbe

_LEAP = 0.02
"""Way in one move, m, beyond which a probe has not swept through tissue: it was lifted and came
down anew."""

_OVERSHOOT = 0.1
"""Slope of the energy where a change ends, over the one where it begins, that does not matter."""

_RELIEF = 0.6
"""Part r of the error of linear interpolation that gaps are relieved of. With 0.5 to 0.7 pushes of
spheres and plates into 2,000 and 8,192 nodes were nearest to a fine mesh's; without, forces were up
to 18 % too great, and with 0.95 up to 15 % too small at a plate's edge."""

_HALVINGS = 6
"""Halvings of an interval of lengths in which the energy is least."""

_LOOP: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}


class PenaltyContact:
    """Gaps between P points and the probe, and the forces that these raise.

    Args:
        probe: the shape that presses.
        stiffness: (P,) N/m, k above.
        greatest_force: (P,) N, F above.
        stiffening: m, d1 above.
        corners: (P, 3), points at the corners of each point's triangle; -1 where there is none.
            Not given, no gap is relieved.
        weights: (P, 3) of these corners, w above.
    """

    def __init__(
        self,
        probe: FlaredProbe,
        stiffness: NDArray[np.float64],
        greatest_force: NDArray[np.float64],
        stiffening: float,
        corners: NDArray[np.integer] | None = None,
        weights: NDArray[np.float64] | None = None,
    ) -> None:
        self.probe = probe
        self.stiffness = stiffness  # (P,) N/m, with which springs begin
        # The real root of k d (1 + (d / d1)^2) = F, for d / d1, after Cardano.
        half = greatest_force / (2 * stiffness * stiffening)
        root = np.cbrt(half + np.sqrt(half * half + 1 / 27))
        self._deepest = stiffening * (root - 1 / (3 * root))  # (P,) m, where the push is F
        self._law = stiffness, self._deepest, stiffening
        self._most_relief = stiffening / 2  # m
        self._inside: NDArray[np.int64] = np.zeros(0, dtype=np.int64)  # points that have corners
        self._corners: NDArray[np.integer] = np.zeros((0, 3), dtype=np.int64)
        self._weights = np.zeros((0, 3))
        if corners is not None and weights is not None:
            self._inside = np.flatnonzero((corners >= 0).all(axis=1))
            self._corners, self._weights = corners[self._inside], weights[self._inside]
        self.clear()

    def clear(self) -> None:
        """Take the probe away."""
        count = len(self.stiffness)
        self._pose: Pose | None = None
        self.near = np.zeros(0, dtype=np.int64)  # points that may come to touch
        self._planar = np.zeros(0, dtype=np.int64)  # points that planes push, not the shape
        self._height = np.zeros(0)  # m along the normal, of these planes
        self.normal = np.zeros((count, 3))  # (P, 3), direction in which the probe pushes
        self._relief = np.zeros(count)  # (P,) m
        self._measure(np.full(count, np.inf))

    def measure_depth(self, pose: Pose, positions: NDArray[np.float64]) -> float:
        """Return how deep (m) a probe would be in points (P, 3) m, at least 0."""
        gap, _ = self.probe.measure_distances(pose, positions)
        return max(0.0, -float(gap.min(initial=np.inf)))

    def set_pose(self, pose: Pose, positions: NDArray[np.float64]) -> None:
        """Put the probe at a pose, the points being at ``positions`` (P, 3) m, frame ``patient``.

        Where a move brings points deep into the probe, the nearest way out is no guide. They are
        pushed back through where they came in, onto a plane; the next pose, or
        `drop_planes`, ends that.
        """
        last, self._pose = self._pose, pose
        gap, self.normal = self.probe.measure_distances(pose, positions)
        self.near = np.flatnonzero(gap < self.probe.reach)
        self._planar = np.flatnonzero(gap < -self.probe.deep)
        if len(self._planar):
            if last is not None and math.dist(last.position, pose.position) > _LEAP:
                last = None
            inside = positions[self._planar]
            gap[self._planar], normal = self.probe.find_entry_planes(last, pose, inside)
            self.normal[self._planar] = normal
            self._height = np.einsum("ij,ij->i", inside, normal) - gap[self._planar]
        self._measure(gap)
        self.update_relief()

    def drop_planes(self, positions: NDArray[np.float64]) -> bool:
        """Let the shape itself push the points at ``positions`` (P, 3) m again, not planes.

        Points that have come near since the pose was set are pushed, too.

        Returns:
            Whether that changes anything.
        """
        if self._pose is None:
            return False
        planar, before = len(self._planar), self.normal_force
        gap, _ = self.probe.measure_distances(self._pose, positions)
        self._planar = self._planar[:0]
        self.near = np.flatnonzero(gap < self.probe.reach)
        self.update_gaps(positions)
        self.update_relief()
        return planar > 0 or not np.array_equal(self.normal_force, before)

    def update_relief(self) -> float:
        """Update the relief of gaps where the points are now.

        Returns:
            m, by how much it changes at most where the probe pushes.
        """
        before, gap = self._relief, self.gap - self._relief
        at = gap[self._corners]
        known = np.isfinite(at).all(axis=1) & np.isfinite(gap[self._inside])
        points, at, weights = self._inside[known], at[known], self._weights[known]
        error = np.einsum("pk,pk->p", weights, at) - gap[points]
        self._relief = np.zeros_like(gap)
        self._relief[points] = np.clip(_RELIEF * error, 0.0, self._most_relief)
        self._relief[self._planar] = 0.0
        self._measure(gap)
        changed = np.abs(self._relief - before)[gap < 0.0]
        return float(changed.max(initial=0.0))

    def update_gaps(self, positions: NDArray[np.float64]) -> None:
        """Update gaps, normals and forces at other positions (P, 3) m."""
        if self._pose is None:
            return
        gap, normal = self.probe.measure_distances(self._pose, positions, self.near)
        if len(planar := self._planar):
            normal[planar] = self.normal[planar]
            gap[planar] = np.einsum("ij,ij->i", positions[planar], normal[planar]) - self._height
        self.normal = normal
        self._measure(gap)

    def _measure(self, gap: NDArray[np.float64]) -> None:
        self.gap = gap + self._relief  # (P,) m, infinite where the probe cannot push
        self.normal_force = np.zeros_like(gap)  # (P,) N, along the normal
        #: J, of all springs.
        self.energy = float(_normal_forces(self.near, self.gap, *self._law, self.normal_force))

    @property
    def slope(self) -> NDArray[np.float64]:
        """(P,) N/m, how fast the pushes fall with the gaps."""
        slope, still = np.zeros_like(self.gap), np.zeros_like(self.normal)
        _slopes(self.near, self.gap, self.normal, still, *self._law, slope)
        return slope

    def curvature(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (K, 3, 3) 1/m, how the push turns as points (K, 3) m move; 0 without a probe."""
        if self._pose is None:
            return np.zeros((len(positions), 3, 3))
        return self.probe.curvature(self._pose, positions)

    @property
    def force(self) -> NDArray[np.float64]:
        """(P, 3) N, on the tissue."""
        force: NDArray[np.float64] = self.normal_force[:, None] * self.normal
        return force

    def force_after(self, change: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (P, 3) N, `force` after points moved by ``change`` (P, 3) m; normals stay."""
        force = np.zeros_like(self.normal)
        _forces(self.near, self.gap, self.normal, change, *self._law, force)
        return force

    def springs_after(
        self, change: NDArray[np.float64]
    ) -> tuple[NDArray[np.integer], NDArray[np.float64], NDArray[np.float64]]:
        """Linearise `force_after` at a change (P, 3) m.

        Returns:
            Points (K,), and their springs' directions (K, 3) and stiffnesses (K,) N/m.
        """
        slope = np.zeros_like(self.gap)
        _slopes(self.near, self.gap, self.normal, change, *self._law, slope)
        active = np.flatnonzero(slope)
        return active, self.normal[active], slope[active]

    def geometric_stiffness(
        self, positions: NDArray[np.float64], push: NDArray[np.float64]
    ) -> tuple[NDArray[np.integer], NDArray[np.float64]]:
        """Return how pushes turn as points move along a curved probe.

        Args:
            positions: (P, 3) m.
            push: (P,) N, at the points.

        Returns:
            Points (K,), and (K, 3, 3) N/m.
        """
        bent = push > 0.0
        bent[self._planar] = False
        turned = np.flatnonzero(bent)
        if self._pose is None or len(turned) == 0:
            return turned[:0], np.zeros((0, 3, 3))
        return turned, push[turned, None, None] * self.curvature(positions[turned])

    def work_along(
        self, start: NDArray[np.float64], change: NDArray[np.float64], length: float
    ) -> float:
        """Return the work (J) of the forces along a change (P, 3) m.

        The forces are those after the points have moved by ``start + length * change``.
        """
        return float(_work(self.near, self.gap, self.normal, start, change, length, *self._law))

    def find_best_length(
        self,
        start: NDArray[np.float64],
        change: NDArray[np.float64],
        pull: float,
        curvature: float,
    ) -> float:
        """Find the fraction of a change that lowers the energy most; below one where points touch.

        The tissue's forces are linear along the change.

        Args:
            start: (P, 3) m, how far the points have moved before.
            change: (P, 3) m, of the points.
            pull: J, of the tissue's forces now along the change of all nodes.
            curvature: J, of its tangent along that.
        """

        def slope(length: float) -> float:
            return length * curvature - pull - self.work_along(start, change, length)

        end = slope(1.0)
        if end <= 0.0 or end <= _OVERSHOOT * abs(slope(0.0)):
            return 1.0
        low, high = 0.0, 1.0
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            low, high = (low, middle) if slope(middle) > 0.0 else (middle, high)
        return (low + high) / 2


@njit(**_LOOP, inline="always")
def _spring_force(depth, stiffness, stiffening):
    """Return the push (N) of a spring at a depth (m)."""
    ratio = depth / stiffening
    return stiffness * depth * (1.0 + ratio * ratio)


@njit(**_LOOP)
def _normal_forces(near, gap, stiffness, deepest, stiffening, push):
    """Fill push (P,) of the points that are near; return the springs' energy."""
    energy = 0.0
    for i in near:
        depth = max(-gap[i], 0.0)
        held = min(depth, deepest[i])
        push[i] = _spring_force(held, stiffness[i], stiffening)
        ratio = held / stiffening
        energy += 0.5 * stiffness[i] * held * held * (1.0 + 0.5 * ratio * ratio)
        energy += push[i] * (depth - held)
    return energy


@njit(**_LOOP)
def _forces(near, gap, normal, change, stiffness, deepest, stiffening, force):
    """Fill force (P, 3) of the points that are near, after a change (P, 3)."""
    for i in near:
        n = normal[i]
        reached = gap[i] + (n[0] * change[i, 0] + n[1] * change[i, 1] + n[2] * change[i, 2])
        if reached < 0.0:
            push = _spring_force(min(-reached, deepest[i]), stiffness[i], stiffening)
            for d in range(3):
                force[i, d] = push * n[d]


@njit(**_LOOP)
def _slopes(near, gap, normal, change, stiffness, deepest, stiffening, slope):
    """Fill slope (P,) of the points that are near, after a change (P, 3)."""
    for i in near:
        n = normal[i]
        reached = gap[i] + (n[0] * change[i, 0] + n[1] * change[i, 1] + n[2] * change[i, 2])
        if 0.0 < -reached < deepest[i]:
            ratio = reached / stiffening
            slope[i] = stiffness[i] * (1.0 + 3.0 * ratio * ratio)


@njit(**_LOOP)
def _work(  # noqa: PLR0913
    near, gap, normal, start, change, length, stiffness, deepest, stiffening
):
    """Return the work of pushes along a change (P, 3), after a start and a length of it."""
    total = 0.0
    for i in near:
        n, a, b = normal[i], start[i], change[i]
        along = n[0] * b[0] + n[1] * b[1] + n[2] * b[2]
        reached = gap[i] + (n[0] * a[0] + n[1] * a[1] + n[2] * a[2]) + length * along
        if reached < 0.0:
            total += along * _spring_force(min(-reached, deepest[i]), stiffness[i], stiffening)
    return total
