"""Friction whose forces have an energy while a frame lasts: springs along the probe's surface.

Each pushed node hangs on the point of the probe where it was touched, by a spring along the surface
that is as stiff as the one square to it, and slips at a greatest force. With s the way along the
surface from that point, and h the force by which it holds already, the trial force t = h + k s has

    energy t^2 / (2 k) up to |t| = c, and c |t| / k - c^2 / (2 k) beyond.

Coulomb's c, the coefficient times the push, is that of the frame before or of a prediction, and
stays while a frame's energy is minimised (M. Li et al., Incremental Potential Contact, ACM Trans.
Graph. 39, 2020, section 5). Between frames nodes that slipped get a new point, where they are now,
and those that stuck a new h = t (the method of multipliers; J. C. Simo and T. A. Laursen, An
augmented Lagrangian treatment of contact problems involving friction, Computers & Structures 42,
1992). So nothing creeps: under a probe at rest s goes to zero.

>>> import numpy as np
>>> from us_sim.geometry.collider import RoundedBox
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tissue.contact.penalty_friction import PenaltyFriction
>>> plate = RoundedBox(0.1, 0.1, 0.03, 0.001)
>>> k, strongest, node = np.array([1e4]), np.array([50.0]), np.zeros((1, 3))
>>> contact = PenaltyFriction(plate, 0.01, k, strongest, 0.5)
>>> contact.aim(Pose([0.0, 0.0, 1e-3]), node)
>>> contact.expect(contact.push)
True
>>> contact.force.round(9)  # touched, and not yet dragged
array([[ 0.,  0., 10.]])
>>> for x in (2e-4, 1e-3):
...     contact.aim(Pose([x, 0.0, 1e-3]), node)
...     print(contact.force.round(9))  # sticking, and slipping
[[ 2.  0. 10.]]
[[ 5.  0. 10.]]
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.collider import Collider
from us_sim.geometry.pose import Pose
from us_sim.tissue.contact.penalty_contact import PenaltyContact

__all__ = ["PenaltyFriction"]

_OVERSHOOT = 0.1
"""Slope of the energy where a change ends, over the one where it begins, that does not matter."""

_HALVINGS = 6
"""Halvings of an interval of lengths in which the energy is least."""


class PenaltyFriction(PenaltyContact):
    """Penalty contact with Coulomb's friction, or with a probe to which touched nodes stick.

    Args:
        collider, spacing, stiffness, strongest: as for `PenaltyContact`. No node is held along the
            surface by more than ``strongest`` either.
        friction: coefficient; infinite for a probe to which nodes stick while it pushes them.
    """

    def __init__(
        self,
        collider: Collider,
        spacing: float,
        stiffness: NDArray[np.float64],
        strongest: NDArray[np.float64],
        friction: float,
    ) -> None:
        self._friction = friction
        super().__init__(collider, spacing, stiffness, strongest)

    def clear(self) -> None:
        """No probe is near."""
        super().clear()
        shape = self.normal.shape
        self._hung = np.zeros(len(self.gap), bool)  # (C,) nodes on springs along the surface
        self._place = np.zeros(shape)  # (C, 3) m, the points on which these hang
        self._held = np.zeros(shape)  # (C, 3) N, h above
        self._positions = np.zeros(shape)  # (C, 3) m, of the nodes when last looked at
        self._hang(np.zeros(len(self.gap)))

    def aim(self, pose: Pose, positions: NDArray[np.float64]) -> None:
        """As `PenaltyContact.aim`; the points on which nodes hang go where the probe went."""
        self._slip()
        before, push = self._pose, self.push
        super().aim(pose, positions)
        self._positions = positions
        if before is not None:
            self._place = pose.apply(before.inverse().apply(self._place))
            self._held = self._held @ before.rotation @ pose.rotation.T
        self._hung &= push > 0.0
        self._hang(np.where(np.isfinite(self.gap), push, 0.0))

    def look(self, positions: NDArray[np.float64]) -> None:
        """Measure gaps, normals, pushes and slips at other positions (C, 3) m."""
        super().look(positions)
        self._positions = positions

    def expect(self, push: NDArray[np.float64]) -> bool:
        """Learn which pushes (C,) N are likely at the new pose; returns if forces change by it."""
        self._hang(push)
        return True

    def augment(self, most: float) -> float:
        """As `PenaltyContact.augment`; and what sticks is held at its point on the probe, what
        slips by what the push allows now.
        """
        before = self.force
        self._held[self._nodes] = self._trial(self._positions)
        self._slip()
        self._hung &= self.push > 0.0
        self._hang(self.push)
        moved = np.linalg.norm(self.force - before, axis=1) / self._stiffness
        return max(super().augment(most), float(moved.max(initial=0.0)))

    def _slip(self) -> None:
        """Hang the nodes that slipped on the points where they are now."""
        trial = self._trial(self._positions)
        size = np.linalg.norm(trial, axis=1)
        slipped = size > self._bound
        nodes, trial = self._nodes[slipped], trial[slipped]
        self._place[nodes] = self._positions[nodes]
        self._held[nodes] = trial * (self._bound[slipped] / size[slipped])[:, None]

    def _hang(self, push: NDArray[np.float64]) -> None:
        """Let friction hold what ``push`` (C,) N, and the normals there, allow."""
        fresh = (push > 0.0) & ~self._hung
        self._place[fresh] = self._positions[fresh]
        self._held[fresh] = 0.0
        self._hung |= fresh
        self._nodes = nodes = np.flatnonzero(self._hung)
        self._normal = normal = self.normal[nodes]
        self._stiff = self._stiffness[nodes]
        strongest = self._strongest[nodes]
        if math.isinf(self._friction):
            self._bound = np.where(push[nodes] > 0.0, strongest, 0.0)
        else:
            self._bound = np.minimum(self._friction * push[nodes], strongest)
        self._held[nodes] = _along(self._held[nodes], normal)

    def _trial(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """(K, 3) N, t above with nodes at positions (C, 3) m."""
        nodes = self._nodes
        slip = _along(positions[nodes] - self._place[nodes], self._normal)
        trial: NDArray[np.float64] = self._held[nodes] + self._stiff[:, None] * slip
        return trial

    @property
    def energy(self) -> float:
        """J, of all springs."""
        size = np.linalg.norm(self._trial(self._positions), axis=1)
        pull = np.minimum(size, self._bound)
        return super().energy + float((pull * (size - pull / 2) / self._stiff).sum())

    @property
    def force(self) -> NDArray[np.float64]:
        """(C, 3) N, on the tissue."""
        return self._with_drag(super().force, self._positions)

    def force_after(self, change: NDArray[np.float64]) -> NDArray[np.float64]:
        """(C, 3) N, `force` after nodes moved by ``change`` (C, 3) m, as normals are now."""
        return self._with_drag(super().force_after(change), self._positions + change)

    def _with_drag(
        self, force: NDArray[np.float64], positions: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        trial = self._trial(positions)
        force[self._nodes] -= trial * _kept(trial, self._bound)[:, None]
        return force

    def springs_after(
        self, change: NDArray[np.float64]
    ) -> tuple[NDArray[np.integer], NDArray[np.float64], NDArray[np.float64]]:
        """As `PenaltyContact.springs_after`, with two springs along the surface where nodes stick,
        and one across the way where they slip.
        """
        pushed, normal, stiffness = super().springs_after(change)
        trial = self._trial(self._positions + change)
        kept = _kept(trial, self._bound)
        along = _directions(trial, self._normal)
        across = np.cross(self._normal, along)
        sticks, turns = kept == 1.0, kept > 0.0
        nodes = np.concatenate([pushed, self._nodes[sticks], self._nodes[turns]])
        order = np.argsort(nodes, kind="stable")
        directions = np.concatenate([normal, along[sticks], across[turns]])
        along_surface = [self._stiff[sticks], (self._stiff * kept)[turns]]
        stiffness = np.concatenate([stiffness, *along_surface])
        return nodes[order], directions[order], stiffness[order]

    def length_along(
        self,
        start: NDArray[np.float64],
        change: NDArray[np.float64],
        pull: float,
        curvature: float,
    ) -> float:
        """How much of a change, along which the tissue's forces are linear, lowers the energy most.

        It is less than all where nodes come to stick, or turn back.

        Args:
            start: (C, 3) m, how far the nodes have moved before.
            change: (C, 3) m, theirs.
            pull: J, of the tissue's forces now along the change of all nodes.
            curvature: J, of its tangent along that.
        """

        def slope(length: float) -> float:
            force = self.force_after(start + length * change)
            return length * curvature - pull - float((force * change).sum())

        if slope(1.0) <= _OVERSHOOT * abs(slope(0.0)):
            return 1.0
        low, high = 0.0, 1.0
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            low, high = (low, middle) if slope(middle) > 0.0 else (middle, high)
        return (low + high) / 2


def _along(vectors: NDArray[np.float64], normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K, 3), vectors (K, 3) without their parts along unit normals (K, 3)."""
    across = np.einsum("ij,ij->i", vectors, normal)
    left: NDArray[np.float64] = vectors - across[:, None] * normal
    return left


def _kept(trial: NDArray[np.float64], bound: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K,) fractions of trial forces (K, 3) N that bounds (K,) N allow."""
    size = np.linalg.norm(trial, axis=1)
    return np.divide(bound, size, out=np.ones_like(size), where=size > bound)


def _directions(trial: NDArray[np.float64], normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K, 3) unit vectors along the surface: those of trial forces, any one where there is none."""
    axis = np.eye(3)[np.abs(normal).argmin(axis=1)]
    size = np.linalg.norm(trial, axis=1)
    some = np.where((size > 0.0)[:, None], trial, _along(axis, normal))
    return some / np.linalg.norm(some, axis=1)[:, None]
