"""Poses of any driver: NDI, OptiTrack, Vicon, a recorded path, or a hand in the viewer."""

from __future__ import annotations

from typing import Any

from geometry_msgs.msg import PoseStamped

from us_sim.nodes.tracker_inputs.device import Device, TrackerInput
from us_sim.tracking.measurement import PATIENT, Measurement


class PoseInput(TrackerInput):
    """``tracker/pose`` in the frame that the scene names.

    Where that is another one than ``patient``, a pose in ``patient`` is the probe's own: who knows
    where the patient is needs neither registration nor calibration.
    """

    def __init__(self, device: Device, settings: Any) -> None:
        super().__init__(device, settings)
        self._frame = device.scene.tracker.frame
        device.listen_to_device(PoseStamped, "tracker/pose", self._take)

    def _take(self, message: PoseStamped) -> None:
        of_probe = message.header.frame_id == PATIENT != self._frame
        frame = PATIENT if of_probe else self._frame
        pose = self._device.pose_in(message, "tracker/pose", frame)
        if pose is not None:
            stamp = self._device.stamp_of(message.header, "tracker/pose")
            self._device.take(Measurement(stamp, pose, of_probe=of_probe))
