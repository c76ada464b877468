"""A SpaceMouse without ROS's own driver, on the topic and with the axes of `spacenav_node`."""

from __future__ import annotations

import sys
import threading
from functools import partial
from typing import Any

from rclpy.time import Time
from sensor_msgs.msg import Joy

from us_sim.errors import TrackingError
from us_sim.nodes.guarded_node import GuardedNode, Health
from us_sim.nodes.parameters import declared
from us_sim.nodes.process import run_node
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
        settings = declared(self, SpaceMouseDriverSettings())
        self._frame = settings.frame_id
        self._patience = 1.0 / settings.rate
        self.health = Health(self, "SpaceMouse")
        self.health.state = "opening"
        self._joys = self.stream(Joy, "spacenav/joy")
        self._lock = threading.Lock()
        self._newest: tuple[int, list[float], list[int]] | None = None
        self._problem, self._name = "", ""
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
                mouse = SpaceMouse()
                try:
                    self._follow(mouse)
                finally:
                    mouse.close()
            except TrackingError as error:
                with self._lock:
                    self._problem = f"{error}; it is tried again"
                self.call_soon(self._work)
                self._closing.wait(RETRY_S)
            except Exception as error:  # so that the thread does not end silently
                self.failed("SpaceMouse", error)
                self._closing.wait(RETRY_S)

    def _follow(self, mouse: SpaceMouse) -> None:
        while not self._closing.is_set():
            mouse.wait(self._patience)
            now = self.get_clock().now().nanoseconds
            with self._lock:
                self._name = mouse.name
                self._newest = now, mouse.axes, mouse.buttons
            self.call_soon(self._work)

    def _work(self) -> None:
        with self._lock:
            newest, self._newest = self._newest, None
            problem, self._problem = self._problem, ""
        if newest is not None:
            stamp, axes, buttons = newest
            message = Joy(axes=axes, buttons=buttons)
            message.header.stamp = Time(nanoseconds=stamp).to_msg()
            message.header.frame_id = self._frame
            self._joys.publish(message)
            self.health.published("spacenav/joy", message.header.stamp)
            self.health.state, self.health.fault = self._name, ""
        if problem:
            self.health.state, self.health.fault = "no device", problem
            self.health.problem("device", problem)


main = partial(run_node, SpaceMouseDriver)


if __name__ == "__main__":
    sys.exit(main())
