"""A 6-DOF mouse that moves the probe.

Axes are those of ROS's `spacenav_node`: forward, left and up, then turns about these (REP 103),
each ±1 at full deflection.

>>> from us_sim.tracking.mouse import SixDofMouse
>>> mouse = SixDofMouse(SixDofMouseSettings(speed=["50 mm/s", "-50 mm/s", "-50 mm/s"]))
>>> for tick in range(101):  # a second at 100 Hz, pushed down
...     probe = mouse.move_probe([0.0, 0.0, -1.0, 0.0, 0.0, 0.0], [], tick * 10_000_000)
>>> probe.pose.position.round(6).tolist()  # from 10 mm above
[0.0, 0.0, 0.04]
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry import se3
from us_sim.geometry.pose import Pose
from us_sim.tracking.measurement import Measurement
from us_sim.tracking.settings import SixDofMouseSettings

_LONGEST_GAP = 0.1  # s between two messages over which the velocity is still believed
_ROUNDING = 1e-3  # how far an axis may be beyond ±1: some drivers divide by a rounded full scale


class SixDofMouse:
    """Turns deflections of a cap into poses of the probe in ``patient``.

    A deflection is a velocity. While the clutch is held the probe stays where it is. At a side of
    the workspace the probe stops, and comes back as soon as the cap does.
    """

    def __init__(self, settings: SixDofMouseSettings) -> None:
        self._settings = settings
        self._used = list(settings.axes)
        self._full = np.array([*settings.speed, *settings.angular_speed])
        self._home = Pose(np.array(settings.home))
        self.last_problem = ""
        self.reset()

    def reset(self) -> None:
        """Bring the probe home and forget all messages."""
        self.pose = self._home
        self._stamp: int | None = None  # ns, of the last message
        self._twist = np.zeros(6)  # of the last message, m/s and rad/s
        self._held: dict[int, bool] = {}

    def move_probe(
        self, axes: Sequence[float], buttons: Sequence[int], stamp: int
    ) -> Measurement | None:
        """Move the probe by a message; None where that cannot be used: `last_problem` says why.

        Args:
            axes: deflections in ±1.
            buttons: 1 where pressed. One that is not listed is as it was: the usual driver lists
                those up to the one that has just changed, and none with a mere movement.
            stamp: ns.
        """
        deflection = self._deflection(axes)
        if deflection is None:
            return None
        step = 0.0 if self._stamp is None else 1e-9 * (stamp - self._stamp)
        if not 0.0 <= step <= _LONGEST_GAP:  # after a long gap, or where stamps jump back
            step = 0.0
        before = self._twist
        self._stamp, self._twist = stamp, self._full * deflection
        clutch = self._is_held(self._settings.clutch_button, buttons)
        home = self._is_held(self._settings.reset_button, buttons)
        if home:
            self.pose = self._home
        elif not clutch:
            # The velocity goes evenly from the last message's to this one's.
            pose = self.pose @ se3.exp(0.5 * step * (before + self._twist))
            low, high = self._settings.workspace_low, self._settings.workspace_high
            self.pose = Pose(np.clip(pose.position, low, high), pose.orientation)
        return Measurement(stamp, self.pose)

    def _deflection(self, axes: Sequence[float]) -> NDArray[np.float64] | None:
        """Return the (6,) deflections of the axes used, counted from the edge of the dead band."""
        last = max(self._used)
        if len(axes) <= last:
            self.last_problem = (
                f"the message has {len(axes)} axes, but axis {last} is used: remap the joystick, "
                f"or set six_dof_mouse.axes"
            )
            return None
        deflection = np.array([axes[axis] for axis in self._used], dtype=np.float64)
        if not np.isfinite(deflection).all():
            self.last_problem = f"the axes {deflection.tolist()} are not finite"
            return None
        beyond = int(np.abs(deflection).argmax())
        if abs(deflection[beyond]) > 1.0 + _ROUNDING:
            self.last_problem = (
                f"axis {self._used[beyond]} is {deflection[beyond]:g}, beyond 1: set the driver's "
                f"full scale to what the device gives at full deflection"
            )
            return None
        band = self._settings.dead_band
        past = np.clip((np.abs(deflection) - band) / (1.0 - band), 0.0, 1.0)
        return np.copysign(past, deflection)

    def _is_held(self, button: int, buttons: Sequence[int]) -> bool:
        if 0 <= button < len(buttons):
            self._held[button] = bool(buttons[button])
        return self._held.get(button, False)
