"""A SpaceMouse or its like, as `spacenav` and other joystick drivers report it."""

from __future__ import annotations

from geometry_msgs.msg import Twist
from sensor_msgs.msg import Joy

from us_sim.nodes.tracker_inputs.device import Device, TrackerInput
from us_sim.tracking.mouse import SixDofMouse
from us_sim.tracking.settings import SixDofMouseSettings


class SixDofMouseInput(TrackerInput):
    """``spacenav/joy``, or ``spacenav/twist`` where there is no joystick message."""

    def __init__(self, device: Device, settings: SixDofMouseSettings) -> None:
        super().__init__(device, settings)
        self._mouse = SixDofMouse(settings)
        self._has_joy = False
        device.listen_to_device(Joy, "spacenav/joy", self._take_joy)
        device.listen_to_device(Twist, "spacenav/twist", self._take_twist)

    def reset(self) -> None:
        """Bring the probe home."""
        self._mouse.reset()

    def _take_joy(self, message: Joy) -> None:
        self._has_joy = True
        stamp = self._device.stamp_of(message.header, "spacenav/joy")
        self._take(list(message.axes), list(message.buttons), stamp, "spacenav/joy")

    def _take_twist(self, message: Twist) -> None:
        """The same deflections without buttons; a driver that sends both is heard once."""
        if self._has_joy:
            return
        v, w = message.linear, message.angular
        axes = [v.x, v.y, v.z, w.x, w.y, w.z]
        self._take(axes, [], self._device.now(), "spacenav/twist")

    def _take(self, axes: list[float], buttons: list[int], stamp: int, topic: str) -> None:
        measurement = self._mouse.axes(axes, buttons, stamp)
        if measurement is not None:
            self._device.take(measurement)
        elif self._mouse.last_problem:
            self._device.refuse("axes", f"{topic}: {self._mouse.last_problem}")
