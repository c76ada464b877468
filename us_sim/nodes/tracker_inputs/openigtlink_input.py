"""Poses from an OpenIGTLink server: Plus, 3D Slicer, or a tracker's own."""

from __future__ import annotations

import dataclasses
from functools import partial

from us_sim.nodes.tracker_inputs.device import TrackerInput, TrackerNode
from us_sim.tracking.measurement import Measurement
from us_sim.tracking.openigtlink import OpenIGTLinkClient
from us_sim.tracking.settings import OpenIGTLinkSettings


class OpenIGTLinkInput(TrackerInput):
    """The device ``tracker.body`` of the server ``tracker.openigtlink``; the newest pose wins."""

    def __init__(self, device: TrackerNode, settings: OpenIGTLinkSettings) -> None:
        super().__init__(device, settings)
        tracker = device.scene.tracker
        self._by_arrival = settings.clock == "arrival"
        server = f"{settings.host}:{settings.port}"
        self._hand_on = device.create_newest_handler(device.take_measurement, server)
        self._client = OpenIGTLinkClient(settings, tracker.body, self._on_pose, self._on_error)

    def close(self) -> None:
        """Disconnect."""
        self._client.close()

    # In the client's thread.

    def _on_pose(self, measurement: Measurement) -> None:
        if self._by_arrival or measurement.stamp == 0:
            measurement = dataclasses.replace(measurement, stamp=self._device.read_clock())
        self._hand_on(measurement)

    def _on_error(self, kind: str, sentence: str) -> None:
        self._device.call_soon(partial(self._device.refuse_measurement, kind, sentence))
