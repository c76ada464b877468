"""A SpaceMouse without ROS's own driver, on the topic and with the axes of `spacenav_node`."""

from __future__ import annotations

import contextlib
import threading
from functools import partial
from typing import Any

from sensor_msgs.msg import Joy

from us_sim.errors import TrackingError
from us_sim.nodes.guarded_node import GuardedNode, Health
from us_sim.nodes.messages import stamp_message
from us_sim.nodes.parameters import declare_settings
from us_sim.nodes.process import node_main
from us_sim.nodes.settings import SpaceMouseDriverSettings
from us_sim.tracking.mouse import SpaceMouse

RETRY_S = 1.0  # how long a device that is not there is left alone


class SpaceMouseDriver(GuardedNode):
    """``spacenav/joy``: six axes in ±1 and the buttons, at each change and while nothing changes.

    Its parameters are those of `SpaceMouseDriverSettings`. While nothing changes the device itself
    is silent, and so it is when it is unplugged.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("space_mouse_driver", **kwargs)
        settings = declare_settings(self, SpaceMouseDriverSettings())
        self._frame = settings.frame_id
        self._patience = 1.0 / settings.rate
        self.health = Health(self, "SpaceMouse")
        self.health.state = "opening"
        self._joys = self.create_stream_publisher(Joy, "spacenav/joy")
        self._take = self.create_newest_handler(self._publish, "SpaceMouse")
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="space mouse", daemon=True)
        self._thread.start()

    def destroy_node(self) -> None:
        """Let go of the device."""
        self._closing.set()
        self._thread.join()
        super().destroy_node()

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                with contextlib.closing(SpaceMouse()) as mouse:
                    while not self._closing.is_set():
                        mouse.wait_for_report(self._patience)
                        now = self.get_clock().now().nanoseconds
                        self._take((now, mouse.name, list(mouse.axes), mouse.buttons))
            except TrackingError as error:
                self.call_soon(partial(self._on_device_lost, f"{error}; it is tried again"))
                self._closing.wait(RETRY_S)
            except Exception as error:  # so that the thread does not end silently
                self.report_failure("SpaceMouse", error)
                self._closing.wait(RETRY_S)

    # In the node's thread.

    def _publish(self, moved: tuple[int, str, list[float], list[int]]) -> None:
        stamp, self.health.state, axes, buttons = moved
        self.health.fault = ""
        message = Joy(axes=axes, buttons=buttons)
        message.header.stamp = stamp_message(stamp)
        message.header.frame_id = self._frame
        self._joys.publish(message)
        self.health.count_published("spacenav/joy", message.header.stamp)

    def _on_device_lost(self, problem: str) -> None:
        self.health.state, self.health.fault = "no device", problem
        self.health.count_problem("device", problem)


main = node_main(SpaceMouseDriver, __name__)
