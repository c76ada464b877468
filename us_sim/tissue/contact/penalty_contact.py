"""Frictionless contact whose forces have an energy: springs between the surface and the probe.

Each node that the probe has entered is pushed out along the probe's normal by a force that rises
with its depth and ends at a greatest one, as a hand cannot push without end:

    energy k d^2 / 2 up to d = F / k, and F (d - F / (2 k)) beyond,    d = max(0, -gap).

It is convex in the gap and has one continuous derivative, so that tissue and contact together have
one energy to minimise (P. Wriggers, Computational Contact Mechanics, 2nd ed. 2006, section 5.1; the
bounded form is P. J. Huber's loss, Robust Estimation of a Location Parameter, Ann. Math. Statist.
35, 1964).

>>> import numpy as np
>>> from us_sim.geometry.collider import Sphere
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tissue.contact.penalty_contact import PenaltyContact
>>> contact = PenaltyContact(Sphere(0.03), 0.01, np.array([1e4]), np.array([5.0]))
>>> contact.aim(Pose(position=[0.0, 0.0, 1e-4]), np.zeros((1, 3)))
>>> contact.push.round(9), contact.normal
(array([1.]), array([[0., 0., 1.]]))
>>> contact.aim(Pose(position=[0.0, 0.0, 0.01]), np.zeros((1, 3)))
>>> contact.push.round(9), round(contact.energy, 9)
(array([5.]), 0.04875)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.collider import Collider
from us_sim.geometry.pose import Pose
from us_sim.tissue.contact.penetration import is_beside, only_forward, push_out

__all__ = ["PenaltyContact"]

_SKIRT = 0.25
"""Fraction of the spacing by which a pushed node must be beside a probe of small rounding to be
let go. Pressed down it moves sideways; let go at once, it would come up and get under the probe
again."""

_FORWARD = 0.99
"""Cosine to the probe's axis above which a push is that of the face, and not of a flank."""


_BESIDE = 0.1
"""Depth in a flank, over the spacing, up to which a node counts as beside the probe."""

_ALIKE = 0.999
"""Cosine between two normals of the same part of a probe."""

_FOLLOWED = 40
"""How often at one pose the planes are fixed anew where the nodes have moved to."""

_FULLY = 6
"""How often of these to the full: that converges in a few frames, or not at all."""


class PenaltyContact:
    """Gaps between C surface nodes and the probe, and the forces that these raise.

    Args:
        collider: the probe's shape.
        spacing: m, between neighbours among the nodes.
        stiffness: (C,) N/m, k above.
        strongest: (C,) N, F above.
    """

    def __init__(
        self,
        collider: Collider,
        spacing: float,
        stiffness: NDArray[np.float64],
        strongest: NDArray[np.float64],
    ) -> None:
        self._collider = collider
        self._spacing = spacing
        self._stiffness = stiffness
        self._strongest = strongest
        #: Whether the probe pushes along planes that `aim` fixes, not along its surface's normal.
        self.forward = only_forward(collider, spacing)
        self.clear()

    @property
    def softness(self) -> NDArray[np.float64]:
        """(C,) m/N, how far the probe sinks in by its pushes, while these are not the greatest."""
        return 1.0 / self._stiffness

    def clear(self) -> None:
        """No probe is near."""
        count = len(self._stiffness)
        self._pose: Pose | None = None
        self._followed = 0
        self._aside = np.zeros(count, dtype=bool)  # (C,), which nodes flanks may push
        self._height: NDArray[np.float64] | None = None  # (C,) m along the normal, of the surface
        self._shift = np.zeros(count)  # (C,) m, how far before the probe the springs end
        self.normal = np.zeros((count, 3))  # (C, 3), direction in which the probe pushes
        self._measure(np.full(count, np.inf))

    def aim(self, pose: Pose, positions: NDArray[np.float64]) -> None:
        """Put the probe at a pose, the nodes being at ``positions`` (C, 3) m, frame ``patient``.

        A probe whose rounding the nodes do not resolve pushes along fixed directions onto planes at
        fixed heights, those of its surface where the nodes are now: at its rim the height changes
        as a node slides, though the push is not along the surface's normal, and such a force has no
        energy. With the planes fixed until the next aim it has one.
        """
        self._followed = 0
        self._aside = np.zeros(len(positions), dtype=bool)
        if self._pose is not None and self.forward:
            # What comes in from the side, and not from before the face.
            margin = _BESIDE * self._spacing
            self._aside = is_beside(self._collider, self._pose, positions, margin)
            self._aside &= ~self._by_face(self._pose)
        before = self.normal
        gap, self.normal = self._gaps(pose, positions)
        likeness = np.einsum("ij,ij->i", before, self.normal)
        self._shift *= np.where(np.isfinite(gap), np.maximum(likeness, 0.0), 0.0)
        self._pose = pose
        self._height = np.einsum("ij,ij->i", positions, self.normal) - gap if self.forward else None
        self._measure(gap)

    def _gaps(
        self, pose: Pose, positions: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        margin = np.where(self._by_face(pose), _SKIRT * self._spacing, 0.0)
        return push_out(self._collider, pose, positions, self._spacing, margin, self._aside)

    def _by_face(self, pose: Pose) -> NDArray[np.bool_]:
        """(C,) which nodes the face pushes."""
        return np.asarray((self.push > 0.0) & (self.normal @ pose.rotation[:, 2] > _FORWARD))

    def follow(self, positions: NDArray[np.float64]) -> float:
        """Fix the planes anew where the nodes have come to be, at ``positions`` (C, 3) m.

        Only their heights: a node that the front pushes is not handed to a flank, nor the other way
        round, as some would go to and fro without end.

        Returns:
            m, the largest change of a pushed node's gap.
        """
        if self._height is None or self._pose is None or self._followed == _FOLLOWED:
            return 0.0
        self._followed += 1
        gap, normal = self._gaps(self._pose, positions)
        alike = np.einsum("ij,ij->i", normal, self.normal) > _ALIKE
        taken = np.isfinite(gap) & (alike | ~np.isfinite(self.gap))
        self.normal = np.where(taken[:, None], normal, self.normal)
        height = np.einsum("ij,ij->i", positions, normal) - gap
        pushed, before = self.push > 0.0, self.gap
        # Later half the way: at the rim heights change faster than nodes slide.
        part = 1.0 if self._followed <= _FULLY else 0.5
        old = np.where(np.isfinite(self._height), self._height, height)
        with np.errstate(invalid="ignore"):
            self._height = np.where(taken, old + part * (height - old), self._height)
        self.look(positions)
        pushed |= self.push > 0.0
        with np.errstate(invalid="ignore"):
            change = np.abs(self.gap[pushed] - before[pushed])
        return float(np.nan_to_num(change, posinf=self._spacing).max(initial=0.0))

    def look(self, positions: NDArray[np.float64]) -> None:
        """Measure gaps, normals and pushes at other positions (C, 3) m."""
        if self._pose is None:
            return
        if self._height is not None:
            gap = np.einsum("ij,ij->i", positions, self.normal) - self._height
        else:
            gap, self.normal = push_out(self._collider, self._pose, positions, self._spacing)
        self._measure(gap)

    def _measure(self, gap: NDArray[np.float64]) -> None:
        self.gap = gap  # (C,) m, infinite where the probe cannot push
        self.push = self.push_at(gap)  # (C,) N, along the normal

    def augment(self, most: float) -> float:
        """Let the springs end before the probe by as much as they are pressed together now.

        So the same pushes come about without the probe sinking in (the method of multipliers; J. C.
        Simo and T. A. Laursen, An augmented Lagrangian treatment of contact problems involving
        friction, Computers & Structures 42, 1992).

        Args:
            most: fraction of the greatest push up to which this is done.

        Returns:
            m, the largest change of where a spring ends.
        """
        shift = np.minimum(self.push, most * self._strongest) / self._stiffness
        change = float(np.abs(shift - self._shift).max(initial=0.0))
        self._shift = shift
        self._measure(self.gap)
        return change

    @property
    def energy(self) -> float:
        """J, of all springs."""
        depth = np.maximum(self._shift - self.gap, 0.0)
        return float((self.push * (depth - self.push / (2 * self._stiffness))).sum())

    def push_at(self, gap: NDArray[np.float64]) -> NDArray[np.float64]:
        """(C,) N, pushes at other gaps (C,) m."""
        return np.clip(self._stiffness * (self._shift - gap), 0.0, self._strongest)

    def slope_at(self, gap: NDArray[np.float64]) -> NDArray[np.float64]:
        """(C,) N/m, how fast the pushes fall with gaps (C,) m."""
        push = self._stiffness * (self._shift - gap)
        return np.where((push > 0.0) & (push < self._strongest), self._stiffness, 0.0)

    @property
    def force(self) -> NDArray[np.float64]:
        """(C, 3) N, on the tissue."""
        force: NDArray[np.float64] = self.push[:, None] * self.normal
        return force

    def force_after(self, change: NDArray[np.float64]) -> NDArray[np.float64]:
        """(C, 3) N, `force` after nodes moved by ``change`` (C, 3) m, as normals are now."""
        reached = self.gap + np.einsum("ij,ij->i", self.normal, change)
        force: NDArray[np.float64] = self.push_at(reached)[:, None] * self.normal
        return force

    def springs_after(
        self, change: NDArray[np.float64]
    ) -> tuple[NDArray[np.integer], NDArray[np.float64], NDArray[np.float64]]:
        """How that falls with the change: nodes (K,), each with all its springs in a row, the
        springs' directions (K, 3) and stiffnesses (K,) N/m.
        """
        slope = self.slope_at(self.gap + np.einsum("ij,ij->i", self.normal, change))
        active = np.flatnonzero(slope > 0.0)
        return active, self.normal[active], slope[active]

    def expect(self, push: NDArray[np.float64]) -> bool:  # noqa: ARG002
        """Learn which pushes (C,) N are likely at the new pose; returns if forces change by it."""
        return False

    @property
    def reach(self) -> NDArray[np.float64]:
        """(C,) m, gaps to where the springs end."""
        return self.gap - self._shift

    def curvature(
        self, positions: NDArray[np.float64], nodes: NDArray[np.integer]
    ) -> NDArray[np.float64]:
        """(K, 3, 3) 1/m, how the surface's normal turns as each of ``nodes`` (K,) moves along it.

        Where the collider is round about a point, a line or a plane, the normal turns in three, two
        or no directions away from it, and along a curved face as that is bent; a push along a fixed
        direction does not turn.
        """
        if self.forward or self._pose is None:
            return np.zeros((len(nodes), 3, 3))
        rotation, box = self._pose.rotation, self._collider.offset_box
        local = (positions[nodes] - self._pose.position) @ rotation
        normal = self.normal[nodes] @ rotation
        if len(box) > 4:
            axes, round_about, bend = _on_curved_box(box, local, normal)
        else:
            local[:, 2] += box[2] + box[3]
            axes, round_about = np.eye(3)[None], np.abs(local) >= box[:3]
            bend = np.zeros(len(nodes))
        axes = rotation @ axes
        shape = (len(nodes), 3, 3)
        turn = np.einsum("kij,kj,kmj->kim", np.broadcast_to(axes, shape), round_about, axes)
        normal = self.normal[nodes]
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
