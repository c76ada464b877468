"""A recorded path in place of a tracker: a bag, or a tracker recording of Plus."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from us_sim.errors import SceneError
from us_sim.nodes.tracker_inputs.device import Device, TrackerInput
from us_sim.scene.building import path_of
from us_sim.settings.spelling import counted
from us_sim.tracking.measurement import PATIENT, Measurement

SHORTEST_S, LONGEST_S = 1e-3, 0.02
"""How often it is looked whether a pose is due, at most and at least."""
CHECK_S, CHECKS = 0.05, 6
"""How often, and how often in a row, all nodes must be there before the first pose."""


class PathInput(TrackerInput):
    """The poses of ``tracker.file``, once, as fast as they were recorded.

    It begins when the scene's other nodes are ready; stamps are the present's.
    """

    def __init__(self, device: Device, settings: Any) -> None:
        super().__init__(device, settings)
        scene = device.scene
        if scene.tracker.file is None:
            raise SceneError(
                f"{scene.origin}: tracker.file: is missing; name the bag or recording to play"
            )
        if device.lockstep:
            raise SceneError(
                f"{scene.origin}: tracker.source: `path` keeps its own time, so it cannot wait for "
                f"images; give the recording with --path"
            )
        self._path = path_of(scene, Path(scene.tracker.file))
        if self._path.note:
            device.get_logger().warning(self._path.note)
        # A recorder's clock may have been set back; what was recorded before is sent before.
        self._due = np.maximum.accumulate(self._path.log_times - self._path.log_times[0])
        self._next = 0
        self._begun = self._checks = 0
        device.get_logger().info("waiting for the simulation")
        self._timer = device.create_timer(CHECK_S, self._begin)

    def _begin(self) -> None:
        device = self._device
        self._checks = self._checks + 1 if device.is_awaited() else 0
        if self._checks < CHECKS:
            return
        self._timer.cancel()
        self._begun = device.now()
        device.get_logger().info(
            f"playing {counted(len(self._path), 'pose')} of {self._path.topic}"
        )
        steps = np.diff(self._due)
        period = 0.5e-9 * float(np.median(steps)) if len(steps) else LONGEST_S
        self._timer = device.create_timer(float(np.clip(period, SHORTEST_S, LONGEST_S)), self._tick)

    def _tick(self) -> None:
        """Hand on each pose whose time has come."""
        now = self._device.now()
        while self._next < len(self._path) and self._due[self._next] <= now - self._begun:
            self._send(self._begun + int(self._due[self._next]))
            self._next += 1
        if self._next == len(self._path):
            self._timer.cancel()
            self._device.get_logger().info("the path is at its end")

    def _send(self, stamp: int) -> None:
        self._device.health.received += 1
        of_probe = self._path.frame_id == PATIENT != self._device.scene.tracker.frame
        pose = self._path.pose(self._next)
        self._device.take(Measurement(stamp, pose, of_probe=of_probe))
