"""One body of a tracker that sends all of its bodies in one message."""

from __future__ import annotations

from typing import Any

from geometry_msgs.msg import PoseArray, PoseStamped

from us_sim.nodes.tracker_inputs.device import Device, TrackerInput
from us_sim.settings.spelling import counted
from us_sim.tracking.measurement import Measurement


class PoseArrayInput(TrackerInput):
    """The pose ``tracker.entry`` of ``tracker/poses``, in the frame that the scene names."""

    def __init__(self, device: Device, settings: Any) -> None:
        super().__init__(device, settings)
        self._entry = device.scene.tracker.entry
        device.listen_to_device(PoseArray, "tracker/poses", self._take)

    def _take(self, message: PoseArray) -> None:
        if self._entry >= len(message.poses):
            self._device.refuse(
                "entry",
                f"tracker/poses holds {counted(len(message.poses), 'pose')}, so none is "
                f"number {self._entry} (from 0): set tracker.entry in the scene",
            )
            return
        entry = PoseStamped(header=message.header, pose=message.poses[self._entry])
        pose = self._device.pose_in(entry, "tracker/poses")
        if pose is not None:
            stamp = self._device.stamp_of(message.header, "tracker/poses")
            self._device.take(Measurement(stamp, pose))
