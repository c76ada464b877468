"""An OpenIGTLink server's poses: Plus, 3D Slicer, or a tracker that speaks it itself."""

from __future__ import annotations

import dataclasses
import threading

from us_sim.errors import StampError
from us_sim.nodes.tracker_inputs.device import Device, TrackerInput
from us_sim.tracking.measurement import Measurement
from us_sim.tracking.openigtlink import OpenIGTLinkClient
from us_sim.tracking.settings import OpenIGTLinkSettings


class OpenIGTLinkInput(TrackerInput):
    """The device ``tracker.body`` of the server ``tracker.openigtlink``; the newest pose wins."""

    def __init__(self, device: Device, settings: OpenIGTLinkSettings) -> None:
        super().__init__(device, settings)
        tracker = device.scene.tracker
        self._by_arrival = settings.clock == "arrival"
        self._lock = threading.Lock()
        self._newest: Measurement | None = None
        self._problems: dict[str, str] = {}
        self._work_soon = device.in_tracker(self._work)
        self._client = OpenIGTLinkClient(settings, tracker.body, self._came, self._went_wrong)

    def close(self) -> None:
        """Disconnect."""
        self._client.close()

    def _came(self, measurement: Measurement) -> None:
        """In the client's thread: keep the newest, and let the node's thread do the rest."""
        if self._by_arrival or measurement.stamp == 0:
            measurement = dataclasses.replace(measurement, stamp=self._device.now())
        with self._lock:
            self._device.health.received += 1
            self._device.health.dropped += self._newest is not None
            self._newest = measurement
        self._work_soon()

    def _went_wrong(self, kind: str, sentence: str) -> None:
        with self._lock:
            self._problems[kind] = sentence
        self._work_soon()

    def _work(self) -> None:
        with self._lock:
            measurement, self._newest = self._newest, None
            problems, self._problems = self._problems, {}
        for kind, sentence in problems.items():
            self._device.refuse(kind, sentence)
        if measurement is None:
            return
        try:
            self._device.take(measurement)
        except StampError as error:
            self._device.refuse("stamp", f"{self._client.place}: {error}; it is not used")
