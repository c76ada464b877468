"""Nodes that slide on the probe's surface without friction, in large deformation.

>>> import numpy as np
>>> from us_sim.geometry.collider import Sphere
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tissue.contact.sliding_contact import SlidingContact
>>> contact = SlidingContact(Sphere(0.03), 0.01)
>>> positions = np.array([[0.0, 0.0, 0.0], [0.05, 0.0, 0.0]])
>>> contact.clear(2)
>>> contact.hold(Pose(position=[0.0, 0.0, 0.01]), 0.0, positions)
>>> contact.touched, positions[0]
(array([ True, False]), array([0.  , 0.  , 0.01]))
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.collider import Collider
from us_sim.geometry.pose import Pose
from us_sim.tissue.contact.penetration import GAP_TOLERANCE, only_forward, push_out

__all__ = ["SlidingContact"]

_SKIRT = 0.25
"""Fraction of the spacing by which a touched node must be beside a probe of small rounding to be
let go. Pressed down it moves sideways; let go at once, it would come up and get under the probe
again."""

_EXACT, _PROJECTIONS = 1e-9, 4
"""Distance from the surface, m, that projections must reach, and how many there may be: one is not
enough where the push direction is not the surface's normal."""


class SlidingContact:
    """The active set of a large-deformation solver: which nodes touch the probe, where, how hard.

    Args:
        collider: the probe's shape.
        spacing: m, between neighbours among the nodes that it can touch.
    """

    def __init__(self, collider: Collider, spacing: float) -> None:
        self._collider = collider
        self._spacing = spacing
        #: Whether the probe pushes along one direction, not along its surface's normal.
        self.forward = only_forward(collider, spacing)
        self.clear(0)

    def clear(self, count: int) -> None:
        """Touch none of ``count`` nodes."""
        self.touched = np.zeros(count, dtype=bool)  # (C,)
        self.gap = np.full(count, np.inf)  # (C,) m
        self.normal = np.zeros((count, 3))  # (C, 3), direction in which the probe pushes
        self.push = np.zeros(count)  # (C,) N, of the probe along the normal, negative when it pulls
        self._height: NDArray[np.float64] | None = None  # (C,) m along the normal, of the surface

    def copy(self) -> SlidingContact:
        """A snapshot to come back to."""
        other = SlidingContact(self._collider, self._spacing)
        other.touched, other.gap = self.touched.copy(), self.gap.copy()
        other.normal, other.push = self.normal.copy(), self.push.copy()
        other._height = self._height  # is replaced, never changed
        return other

    def look(self, pose: Pose, retreat: float, positions: NDArray[np.float64]) -> None:
        """Measure gaps and normals at ``positions`` (C, 3).

        Args:
            pose: of the probe.
            retreat: m, added to all gaps.
            positions: m, frame ``patient``.
        """
        if self._height is not None:
            self.gap = np.einsum("ij,ij->i", positions, self.normal) - self._height
            return
        margin = np.where(self.touched, _SKIRT * self._spacing, 0.0)
        gap, self.normal = push_out(self._collider, pose, positions, self._spacing, margin)
        self.gap = gap + retreat
        self.touched &= np.isfinite(gap)

    def aim(self, pose: Pose, retreat: float, positions: NDArray[np.float64]) -> None:
        """As `look`, and fix how far the probe pushes if it does so along one direction.

        At the rounding of such a probe the height of the surface changes as a node slides, though
        the push is not along the surface's normal: such a force has no energy. With the heights
        fixed where the nodes are now it has one, which can be minimised until the next aim.
        """
        self._height = None
        self.look(pose, retreat, positions)
        if self.forward:
            self._height = np.einsum("ij,ij->i", positions, self.normal) - self.gap

    def hold(self, pose: Pose, retreat: float, positions: NDArray[np.float64]) -> None:
        """Add the nodes that the probe has entered, and move all touched ones onto it, in place."""
        self.look(pose, retreat, positions)
        for _ in range(_PROJECTIONS):
            self.touched |= self.gap < -GAP_TOLERANCE
            off = self.touched & (np.abs(self.gap) > _EXACT)
            if not off.any():
                return
            positions[off] -= self.gap[off, None] * self.normal[off]
            self.look(pose, retreat, positions)

    def weigh(self, force: NDArray[np.float64]) -> NDArray[np.float64]:
        """(C, 3) N, the part that the probe does not balance of the holding forces (C, 3) N.

        The probe balances pushes along the normals of touched nodes, and no pulls.
        """
        self.push = np.where(self.touched, np.einsum("ij,ij->i", force, self.normal), 0.0)
        return force - np.maximum(self.push, 0.0)[:, None] * self.normal

    def release(self) -> None:
        """Let go the nodes that the probe would have to pull."""
        self.touched &= self.push >= 0.0
        self.push[~self.touched] = 0.0

    def curvature(self, pose: Pose, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """(K, 3, 3) 1/m, how the surface's normal turns as each touched node moves along it.

        Where the collider is round about a point, a line or a plane, the normal turns in three, two
        or no directions away from it, and along a curved face as that is bent; a push along a fixed
        direction does not turn.
        """
        count = int(self.touched.sum())
        if self.forward:
            return np.zeros((count, 3, 3))
        rotation, box = pose.rotation, self._collider.offset_box
        local = (positions[self.touched] - pose.position) @ rotation
        normal = self.normal[self.touched] @ rotation
        if len(box) > 4:
            axes, round_about, bend = _on_curved_box(box, local, normal)
        else:
            local[:, 2] += box[2] + box[3]
            axes, round_about = np.eye(3)[None], np.abs(local) >= box[:3]
            bend = np.zeros(count)
        axes = rotation @ axes
        turn = np.einsum("kij,kj,kmj->kim", np.broadcast_to(axes, (count, 3, 3)), round_about, axes)
        normal = self.normal[self.touched]
        turn -= normal[:, :, None] * normal[:, None, :]
        along = axes[:, :, 0]
        return turn / box[3] + bend[:, None, None] * along[:, :, None] * along[:, None, :]


def _on_curved_box(
    box: NDArray[np.float64], local: NDArray[np.float64], normal: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.float64]]:
    """At points (K, 3) m in frame ``probe`` and normals there: axes, as the columns of (K, 3, 3),
    along the curved front, along y and out of the front; about which of these directions' ends the
    surface is round (K, 3); and how it is bent along the first (K,) 1/m.
    """
    radius, rounding = 1 / box[4], box[3]
    steepest = np.arcsin(box[0] / radius)
    above = local[:, 2] + rounding + radius
    beyond = np.abs(local[:, 0]) > box[0]
    side = beyond & (above < radius * np.cos(steepest))
    angle = np.arctan2(local[:, 0], above)
    end = np.abs(angle) >= steepest
    angle = np.where(side, 0.0, np.clip(angle, -steepest, steepest))
    axes = np.zeros((len(local), 3, 3))
    axes[:, 0, 0] = axes[:, 2, 2] = np.cos(angle)
    axes[:, 0, 2] = np.sin(angle)
    axes[:, 2, 0] = -np.sin(angle)
    axes[:, 1, 1] = 1.0
    round_about = np.column_stack([end, np.abs(local[:, 1]) >= box[1], ~side])
    out = np.einsum("ki,ki->k", normal, axes[:, :, 2])
    return axes, round_about, np.where(end, 0.0, out / (radius + rounding * out))
