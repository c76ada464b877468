"""Friction whose forces have an energy while a frame lasts: springs along the probe's surface.

Each pushed point hangs on the place of the probe where it was touched, by a spring along the
surface that is as stiff as the one square to it begins, and slips at a greatest force. With t the
spring's force, stretched by s, the energy is

    t^2 / (2 k) up to |t| = c, and c |t| / k - c^2 / (2 k) beyond,    t = k s.

Coulomb's c, the coefficient times the push, is that of the frame before or of a prediction, and
stays while a frame's energy is minimised (M. Li et al., Incremental Potential Contact, ACM Trans.
Graph. 39, 2020, section 5). Between frames the places of points that slipped follow them, until
their springs hold c again (return mapping; J. C. Simo and T. J. R. Hughes, Computational
Inelasticity, 1998, section 1.4). So nothing creeps under a probe at rest.

>>> import numpy as np
>>> from us_sim.geometry.collider import RoundedBox
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tissue.contact.flared_probe import FlaredProbe
>>> from us_sim.tissue.contact.penalty_friction import PenaltyFriction
>>> plate, point = FlaredProbe(RoundedBox(0.1, 0.1, 0.03, 0.001), 0.01), np.zeros((1, 3))
>>> contact = PenaltyFriction(plate, np.array([1e4]), np.array([50.0]), 1.0, friction=0.5)
>>> contact.aim(Pose([0.0, 0.0, 1e-3]), point)
>>> contact.expect(contact.push)
True
>>> contact.force.round(3)  # touched, and not yet dragged
array([[ 0.,  0., 10.]])
>>> for x in (2e-4, 1e-3):
...     contact.aim(Pose([x, 0.0, 1e-3]), point)
...     print(contact.force.round(3))  # sticking, and slipping
[[ 2.  0. 10.]]
[[ 5.  0. 10.]]
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Pose
from us_sim.tissue.contact.flared_probe import FlaredProbe
from us_sim.tissue.contact.penalty_contact import PenaltyContact


class PenaltyFriction(PenaltyContact):
    """Penalty contact with Coulomb's friction, or with a probe to which touched points stick.

    Args:
        probe, stiffness, strongest, stiffening: as for `PenaltyContact`. No point is held along the
            surface by more than ``strongest`` either.
        friction: coefficient; infinite for a probe to which points stick while it pushes them.
    """

    def __init__(
        self,
        probe: FlaredProbe,
        stiffness: NDArray[np.float64],
        strongest: NDArray[np.float64],
        stiffening: float,
        friction: float,
    ) -> None:
        self._friction = friction
        super().__init__(probe, stiffness, strongest, stiffening)

    def clear(self) -> None:
        """No probe is near."""
        super().clear()
        shape = self.normal.shape
        self._hung = np.zeros(len(self.gap), bool)  # (P,) points on springs along the surface
        self._place = np.zeros(shape)  # (P, 3) m, where these hang
        self._positions = np.zeros(shape)  # (P, 3) m, of the points when last looked at
        self._hang(np.zeros(len(self.gap)))

    def aim(self, pose: Pose, positions: NDArray[np.float64]) -> None:
        """As `PenaltyContact.aim`; the places where points hang go where the probe went."""
        self._slip()
        before, push = self._pose, self.push
        super().aim(pose, positions)
        self._positions = positions
        if before is not None:
            self._place = pose.apply(before.inverse().apply(self._place))
        self._hung &= push > 0.0
        self._hang(np.where(np.isfinite(self.gap), push, 0.0))

    def look(self, positions: NDArray[np.float64]) -> None:
        """Measure gaps, normals, pushes and slips at other positions (P, 3) m."""
        super().look(positions)
        self._positions = positions

    def expect(self, push: NDArray[np.float64]) -> bool:
        """Learn which pushes (P,) N are likely at the new pose; returns if forces change by it."""
        self._hang(push)
        return True

    def settle(self) -> float:
        """Let a frame end: what slips is held by what the push allows now.

        Returns:
            m, by how much springs are longer or shorter for it at most.
        """
        before = self.force
        self._slip()
        self._hung &= self.push > 0.0
        self._hang(self.push)
        changed = np.linalg.norm(self.force - before, axis=1) / self.stiffness
        return float(changed.max(initial=0.0))

    def _slip(self) -> None:
        """Let the places of points that slipped follow these."""
        trial = self._trial(self._positions)
        size = np.linalg.norm(trial, axis=1)
        slipped = size > self._bound
        points, trial = self._points[slipped], trial[slipped]
        too_long = (1.0 - self._bound[slipped] / size[slipped]) / self._stiff[slipped]
        self._place[points] += too_long[:, None] * trial

    def _hang(self, push: NDArray[np.float64]) -> None:
        """Let friction hold what ``push`` (P,) N, and the normals there, allow."""
        fresh = (push > 0.0) & ~self._hung
        self._place[fresh] = self._positions[fresh]
        self._hung |= fresh
        self._points = points = np.flatnonzero(self._hung)
        self._normal = self.normal[points]
        self._stiff = self.stiffness[points]
        strongest = self._strongest[points]
        if math.isinf(self._friction):
            self._bound = np.where(push[points] > 0.0, strongest, 0.0)
        else:
            self._bound = np.minimum(self._friction * push[points], strongest)

    def _trial(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """(K, 3) N, t above with points at positions (P, 3) m."""
        points = self._points
        slip = _along(positions[points] - self._place[points], self._normal)
        trial: NDArray[np.float64] = self._stiff[:, None] * slip
        return trial

    @property
    def energy(self) -> float:
        """J, of all springs."""
        size = np.linalg.norm(self._trial(self._positions), axis=1)
        pull = np.minimum(size, self._bound)
        return super().energy + float((pull * (size - pull / 2) / self._stiff).sum())

    @property
    def force(self) -> NDArray[np.float64]:
        """(P, 3) N, on the tissue."""
        return self._with_drag(super().force, self._positions)

    def force_after(self, change: NDArray[np.float64]) -> NDArray[np.float64]:
        """(P, 3) N, `force` after points moved by ``change`` (P, 3) m, as normals are now."""
        return self._with_drag(super().force_after(change), self._positions + change)

    def work_along(
        self, start: NDArray[np.float64], change: NDArray[np.float64], length: float
    ) -> float:
        """As `PenaltyContact.work_along`."""
        trial = self._trial(self._positions + start + length * change)
        drag = trial * _kept(trial, self._bound)[:, None]
        work = super().work_along(start, change, length)
        return work - float((drag * change[self._points]).sum())

    def _with_drag(
        self, force: NDArray[np.float64], positions: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        trial = self._trial(positions)
        force[self._points] -= trial * _kept(trial, self._bound)[:, None]
        return force

    def springs_after(
        self, change: NDArray[np.float64]
    ) -> tuple[NDArray[np.integer], NDArray[np.float64], NDArray[np.float64]]:
        """As `PenaltyContact.springs_after`, with two springs along the surface where points stick,
        and one across the way where they slip.
        """
        pushed, normal, stiffness = super().springs_after(change)
        trial = self._trial(self._positions + change)
        kept = _kept(trial, self._bound)
        along = _directions(trial, self._normal)
        across = np.cross(self._normal, along)
        sticks, turns = kept == 1.0, kept > 0.0
        points = np.concatenate([pushed, self._points[sticks], self._points[turns]])
        directions = np.concatenate([normal, along[sticks], across[turns]])
        along_surface = [self._stiff[sticks], (self._stiff * kept)[turns]]
        stiffness = np.concatenate([stiffness, *along_surface])
        return points, directions, stiffness


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
