"""A SpaceMouse or its like, as `spacenav` and other joystick drivers report it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geometry_msgs.msg import Twist
from rclpy.time import Time
from sensor_msgs.msg import Joy

from us_sim.tracking.mouse.settings import SixDofMouseSettings
from us_sim.tracking.mouse.six_dof_mouse import SixDofMouse

if TYPE_CHECKING:
    from us_sim.nodes.probe_tracker import ProbeTracker

__all__ = ["SixDofMouseInput"]


class SixDofMouseInput:
    """``spacenav/joy``, or ``spacenav/twist`` where there is no joystick message."""

    def __init__(self, node: ProbeTracker) -> None:
        self._node = node
        self._mouse = SixDofMouse(node.scene.tracker.six_dof_mouse or SixDofMouseSettings())
        self._has_joy = False
        node.listen_to_device(Joy, "spacenav/joy", self._take_joy)
        node.listen_to_device(Twist, "spacenav/twist", self._take_twist)

    def _take_joy(self, message: Joy) -> None:
        self._has_joy = True
        stamp = self._node.stamp_of(message.header, "spacenav/joy")
        self._take(list(message.axes), list(message.buttons), stamp, "spacenav/joy")

    def _take_twist(self, message: Twist) -> None:
        """The same deflections without buttons; a driver that sends both is heard once."""
        if self._has_joy:
            return
        v, w = message.linear, message.angular
        now = Time.from_msg(self._node.get_clock().now().to_msg()).nanoseconds
        self._take([v.x, v.y, v.z, w.x, w.y, w.z], [], now, "spacenav/twist")

    def _take(self, axes: list[float], buttons: list[int], stamp: int, topic: str) -> None:
        measurement = self._mouse.axes(axes, buttons, stamp)
        if measurement is not None:
            self._node.take(measurement)
        elif self._mouse.last_problem:
            self._node.refuse("axes", f"{topic}: {self._mouse.last_problem}")
