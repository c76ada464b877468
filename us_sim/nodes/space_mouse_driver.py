"""A SpaceMouse without ROS's own driver, on the topic and with the axes of `spacenav_node`."""

from __future__ import annotations

import contextlib
from typing import Any

from sensor_msgs.msg import Joy
from std_msgs.msg import Header

from us_sim.nodes.device_driver import DeviceDriver
from us_sim.nodes.parameters import declare_settings
from us_sim.nodes.process import node_main
from us_sim.nodes.settings import SpaceMouseDriverSettings
from us_sim.tracking.space_mouse import SpaceMouse


class SpaceMouseDriver(DeviceDriver):
    """``spacenav/joy``: six axes in ±1 and the buttons, at each change and while nothing changes.

    Its parameters are those of `SpaceMouseDriverSettings`. While nothing changes the device itself
    is silent, and so it is when it is unplugged.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("space_mouse_driver", "device", **kwargs)
        self._settings = declare_settings(self, SpaceMouseDriverSettings())
        self._joys = self.create_stream_publisher(Joy, "spacenav/joy")
        self._hand_on = self.create_newest_handler(self._publish, "SpaceMouse")
        self.start_reading("SpaceMouse")

    def read_device(self) -> None:
        """Hand on the state of the mouse, in its thread, after each report or a while without."""
        with contextlib.closing(SpaceMouse()) as mouse:
            while not self.closing.is_set():
                mouse.wait_for_report(1.0 / self._settings.rate)
                now = self.get_clock().now().to_msg()
                header = Header(stamp=now, frame_id=self._settings.frame_id)
                joy = Joy(header=header, axes=mouse.axes, buttons=mouse.buttons)
                self._hand_on((mouse.name, joy))

    def _publish(self, newest: tuple[str, Joy]) -> None:
        self.health.state, joy = newest
        self.health.fault = ""
        self._joys.publish(joy)
        self.health.count_published("spacenav/joy", joy.header.stamp)


main = node_main(SpaceMouseDriver, __name__)
