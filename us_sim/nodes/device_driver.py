"""A driver of a device that may come and go."""

from __future__ import annotations

import threading
from abc import abstractmethod
from functools import partial
from typing import Any

from us_sim.errors import TrackingError
from us_sim.nodes.guarded_node import GuardedNode, Health

RETRY_S = 1.0  # until a device that was not there is tried again
END_S = 1.0  # for which a message that is awaited may delay the node's end


class DeviceDriver(GuardedNode):
    """A node with a thread that reads a device, and opens it again while it is lost.

    Args:
        name: of the node.
        device: what reports call it.
    """

    def __init__(self, name: str, device: str, **kwargs: Any) -> None:
        super().__init__(name, **kwargs)
        self._device = device
        self.closing = threading.Event()  # set when nothing more is to be read
        self._thread = threading.Thread(target=self._run, name=device, daemon=True)

    def start_reading(self, hardware_id: str) -> None:
        """Start the thread, and report the device in diagnostics under its own name."""
        self.health = Health(self, hardware_id)
        self.health.state = "opening"
        self._thread.start()

    @abstractmethod
    def read_device(self) -> None:
        """Open the device, in its thread, and hand on what it sends until ``closing`` is set.

        Raises:
            TrackingError: it is not there, or not any more.
        """

    def destroy_node(self) -> None:
        """Let go of the device; one that hangs is left to the process's end."""
        self.closing.set()
        self._thread.join(END_S)
        super().destroy_node()

    def _run(self) -> None:
        while not self.closing.is_set():
            try:
                self.read_device()
            except TrackingError as error:
                self.call_soon(partial(self._on_lost, f"{error}; it is tried again"))
            except Exception as error:  # so that the thread does not end silently
                self.report_failure(self._device, error)
            self.closing.wait(RETRY_S)

    def _on_lost(self, problem: str) -> None:
        self.health.state, self.health.fault = f"no {self._device}", problem
        self.health.count_problem(self._device, problem)
