"""Poses of any driver: NDI, OptiTrack, Vicon, a recorded path."""

from __future__ import annotations

from typing import Any

from geometry_msgs.msg import PoseStamped

from us_sim.nodes.tracker_inputs.device import Device, TrackerInput
from us_sim.tracking.measurement import Measurement

__all__ = ["PoseInput"]


class PoseInput(TrackerInput):
    """``tracker/pose`` in the frame that the scene names."""

    def __init__(self, device: Device, settings: Any) -> None:
        super().__init__(device, settings)
        device.listen_to_device(PoseStamped, "tracker/pose", self._take)

    def _take(self, message: PoseStamped) -> None:
        pose = self._device.pose_in(message, "tracker/pose")
        if pose is not None:
            stamp = self._device.stamp_of(message.header, "tracker/pose")
            self._device.take(Measurement(stamp, pose))
