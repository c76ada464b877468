"""A haptic arm's handle moves the probe, and feels what the probe feels.

>>> import numpy as np
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tracking.haptic.device import HapticDevice
>>> from us_sim.tracking.haptic.settings import HapticSettings
>>> arm = HapticDevice(HapticSettings(scale=2.0))
>>> arm.take(Pose([0.01, 0.0, 0.0]), 1).pose.position
array([0.02, 0.  , 0.  ])
>>> arm.clutch(True)
>>> arm.take(Pose([0.03, 0.0, 0.0]), 2).pose.position  # stays
array([0.02, 0.  , 0.  ])
>>> arm.clutch(False)
>>> arm.take(Pose([0.03, 0.0, 0.01]), 3).pose.position
array([0.02, 0.  , 0.02])
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry import se3
from us_sim.geometry.pose import Pose
from us_sim.tracking.haptic.settings import HapticSettings
from us_sim.tracking.measurement import Measurement


class HapticDevice:
    """The coupling of a haptic arm's handle and the probe.

    The handle's translation is scaled, its rotation is not. While the clutch is held the probe
    stays; then it goes on from there, with the handle wherever it is.

    Args:
        settings: the scales.
        registration: the arm's base in ``patient``.
        calibration: the probe in the handle's frame.
    """

    def __init__(
        self,
        settings: HapticSettings,
        registration: Pose | None = None,
        calibration: Pose | None = None,
    ) -> None:
        self._scale, self._force_scale = settings.scale, settings.force_scale
        #: Work on the handle over work on the probe.
        self.work_ratio = settings.force_scale / settings.scale
        registration, calibration = registration or Pose(), calibration or Pose()
        self._turn = registration.rotation
        #: (3,) m, from the handle's origin to the probe's, along the probe's axes.
        self._lever = calibration.rotation.T @ calibration.position
        self.reset()

    def reset(self) -> None:
        """Forget the displacement of the handle's frame by the clutch."""
        self._offset = np.zeros(3)  # m, added to the scaled position
        self._regrip = Pose().orientation  # turns the handle in its own frame
        self._held: Pose | None = None  # where the body is kept
        self._last: Pose | None = None  # of the handle
        self.is_held = False

    def take(self, pose: Pose, stamp: int) -> Measurement:
        """The body that carries the probe, in the arm's frame.

        Args:
            pose: of the handle in the arm's frame.
            stamp: ns.
        """
        self._last = pose
        body = self._held or self._body(pose)
        if self.is_held:
            self._held = body
        return Measurement(stamp, body)

    def clutch(self, held: bool) -> None:
        """Hold the probe where it is, or let it go on from there."""
        if held and not self.is_held and self._last is not None:
            self._held = self._body(self._last)
        if not held and self._held is not None and self._last is not None:
            x, y, z, w = self._last.orientation
            self._offset = self._held.position - self._scale * self._last.position
            self._regrip = se3.product(np.array([-x, -y, -z, w]), self._held.orientation)
            self._held = None
        self.is_held = held

    def _body(self, pose: Pose) -> Pose:
        return Pose(
            self._scale * pose.position + self._offset,
            se3.product(pose.orientation, self._regrip),
        )

    def probe_moved(self, probe: Pose, before: Pose, now: Pose) -> NDArray[np.float64]:
        """How the probe moves with the handle, whatever the clutch did earlier.

        Args:
            probe: in ``patient``, when the handle was at ``before``.
            before, now: of the handle in the arm's frame.

        Returns:
            (6,) m, rad: displacement of its origin, and its rotation vector, axes of ``patient``.
        """
        moved = np.empty(6)
        moved[:3] = self._turn @ (self._scale * (now.position - before.position))
        moved[3:] = self._turn @ se3.rotation_between(before.orientation, now.orientation)
        if self._lever.any():
            arm = probe.rotation @ self._lever
            moved[:3] += _turned(arm, moved[3:]) - arm
        return moved

    def on_handle(
        self, probe: Pose, turn: NDArray[np.float64], wrench: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """(6,) N, N m: what the handle must feel, about its origin along the axes of the arm.

        Its work is that of the wrench on the probe times `work_ratio`: what takes no energy there
        takes none here.

        Args:
            probe: in ``patient``, before it has turned.
            turn: (3,) rad, its rotation vector since.
            wrench: (6,) N, N m, on the probe about its origin, axes of ``patient``.
        """
        force, torque = wrench[:3], wrench[3:]
        if self._lever.any():
            arm = _turned(probe.rotation @ self._lever, turn)
            torque = torque + se3.cross_matrix(arm) @ force
        felt = np.empty(6)
        felt[:3] = self._force_scale * (force @ self._turn)
        felt[3:] = self.work_ratio * (torque @ self._turn)
        return felt

    def direction_on_handle(self, direction: NDArray[np.float64]) -> NDArray[np.float64]:
        """(3,) along the axes of the arm, of (3,) along those of ``patient``."""
        return direction @ self._turn


def _turned(vector: NDArray[np.float64], turn: NDArray[np.float64]) -> NDArray[np.float64]:
    """A vector (3,), turned by a rotation vector (3,) rad."""
    return Pose(orientation=se3.rotation_exp(turn)).rotation @ vector
