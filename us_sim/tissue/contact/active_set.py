"""The set of nodes that the probe pushes, for solvers that prescribe their displacement.

>>> import numpy as np
>>> from us_sim.geometry.collider import Sphere
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tissue.contact.active_set import ActiveSet
>>> contact = ActiveSet(Sphere(0.03), np.array([[0.0, 0.0, 0.0], [0.05, 0.0, 0.0]]), 0.01)
>>> displacement = np.zeros((2, 3))
>>> contact.update(Pose(position=[0.0, 0.0, 0.01]), displacement)
True
>>> contact.touched, displacement[0]
(array([ True, False]), array([0.  , 0.  , 0.01]))
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.collider import Collider
from us_sim.geometry.pose import Pose
from us_sim.tissue.contact.probe_gap import GAP_TOLERANCE, measure_gaps

_CLEARANCE = 1e-3
"""A touched node is let go at once when the probe is this far from it and from its rest position,
m. Until the force changed sign, a probe that jumped away would pull the node along."""

_NEAR = 1e-4
"""A node this near the probe counts as pushed when another solver's state is taken over, m."""

_SKIRT = 0.25
"""Fraction of the spacing by which a touched node must be beside the probe to be let go. A node at
the rim that is pressed down moves sideways; let go at once, it would come up, get under the probe
again, and so on without end."""

_DRIFT, _LITTLE_DRIFT = 1e-4, 1e-9  # m
_TURN, _LITTLE_TURN = 0.05, 1e-7  # rad
"""Errors from which on a touched node's prescribed displacement and its normal are renewed, as they
become outdated when it slides along a curved surface: during the search, and at its end. Renewing
starts the search anew."""


class ActiveSet:
    """Frictionless unilateral contact: nodes join when entered and leave when they would be pulled.

    Args:
        collider: the probe's shape.
        rest: (C, 3) m, rest positions of the nodes that it can touch, frame ``patient``.
        spacing: m, between neighbours among them.
    """

    def __init__(self, collider: Collider, rest: NDArray[np.float64], spacing: float) -> None:
        self._collider = collider
        self._rest = rest
        self._spacing = spacing
        self.touched = np.zeros(len(rest), dtype=bool)  # (C,)
        self.normal = np.zeros((len(rest), 3))  # (C, 3), of the probe at touched nodes
        self.normal_force = np.zeros(len(rest))  # (C,) N, along the normal

    def clear(self) -> None:
        """Let go of all nodes."""
        self.touched[:] = False
        self.normal[:] = 0.0
        self.normal_force[:] = 0.0

    def mark_touching(self, pose: Pose, displacement: NDArray[np.float64]) -> None:
        """Mark the nodes on the probe's surface as touched; the next update lets pulled ones go."""
        gap, self.normal = self._measure_gaps(pose, self._rest + displacement)
        self.touched = gap < _NEAR
        self.normal_force[:] = 0.0

    def update(
        self,
        pose: Pose | None,
        displacement: NDArray[np.float64],
        *,
        exactly: bool = True,
        moved: bool = True,
    ) -> bool:
        """Let go nodes that are pulled, add those entered, and move touched ones onto the probe.

        Args:
            pose: of the probe, or None when none is near.
            displacement: (C, 3) m, corrected in place.
            exactly: whether nodes that slid a little are corrected too.
            moved: whether the probe has moved since the last update.

        Returns:
            Whether the equations changed: the set, a normal, or a displacement.
        """
        if pose is None:
            changed = bool(self.touched.any())
            self.clear()
            return changed
        gap, normal = self._measure_gaps(pose, self._rest + displacement)
        touched = self.touched & (self.normal_force >= 0) & np.isfinite(gap)
        departed = touched & (gap > _CLEARANCE)
        if moved and departed.any():
            rest_gap, _ = measure_gaps(self._collider, pose, self._rest[departed], self._spacing)
            touched[np.flatnonzero(departed)[rest_gap > _CLEARANCE]] = False
        touched |= gap < -GAP_TOLERANCE
        off = touched & (np.abs(gap) > (_LITTLE_DRIFT if exactly else _DRIFT))
        turn = np.abs(normal - self.normal).max(axis=1)
        turned = touched & (turn > (_LITTLE_TURN if exactly else _TURN))
        if not (off.any() or turned.any() or (touched != self.touched).any()):
            return False
        displacement[touched] -= gap[touched, None] * normal[touched]
        self.normal_force[~touched] = 0.0
        self.touched = touched
        self.normal = np.where(touched[:, None], normal, 0.0)
        return True

    def is_consistent(self, pose: Pose | None, displacement: NDArray[np.float64]) -> bool:
        """Return whether an update would change nothing."""
        if pose is None:
            return not self.touched.any()
        gap, _ = self._measure_gaps(pose, self._rest + displacement)
        return not (
            (gap < -GAP_TOLERANCE).any()
            or (np.abs(gap[self.touched]) > GAP_TOLERANCE).any()
            or (self.normal_force[self.touched] < 0).any()
        )

    def compute_normals(
        self, pose: Pose | None, displacement: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return (C, 3) directions in which the probe pushes touched nodes; zero at all others."""
        if pose is None:
            return np.zeros_like(self.normal)
        _, normal = self._measure_gaps(pose, self._rest + displacement)
        return np.where(self.touched[:, None], normal, 0.0)

    def set_forces(self, force: NDArray[np.float64]) -> None:
        """Set the pushes: the normal parts of the forces (C, 3) N that hold the nodes."""
        self.normal_force = np.where(self.touched, np.einsum("ij,ij->i", force, self.normal), 0.0)

    def _measure_gaps(
        self, pose: Pose, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        skirt = np.where(self.touched, _SKIRT * self._spacing, 0.0)
        return measure_gaps(self._collider, pose, points, self._spacing, skirt)
