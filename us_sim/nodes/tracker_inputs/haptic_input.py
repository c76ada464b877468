"""A haptic arm's handle, as its driver reports it up to a thousand times a second."""

from __future__ import annotations

from geometry_msgs.msg import PoseStamped
from std_msgs.msg import Bool

from us_sim.nodes.tracker_inputs.device import Device, TrackerInput
from us_sim.tracking.haptic import HapticDevice
from us_sim.tracking.settings import HapticSettings


class HapticInput(TrackerInput):
    """``haptic/pose`` in the frame that the scene names; ``haptic/clutch`` holds the probe."""

    def __init__(self, device: Device, settings: HapticSettings) -> None:
        super().__init__(device, settings)
        self._handle = HapticDevice(settings)
        device.listen_to_device(PoseStamped, "haptic/pose", self._take)
        device.listen_to_device(Bool, "haptic/clutch", self._clutch)

    def reset(self) -> None:
        """Forget the clutch."""
        self._handle.reset()

    def _take(self, message: PoseStamped) -> None:
        pose = self._device.pose_in(message, "haptic/pose")
        if pose is None:
            return
        stamp = self._device.stamp_of(message.header, "haptic/pose")
        self._device.take(self._handle.take(pose, stamp))

    def _clutch(self, message: Bool) -> None:
        self._handle.clutch(message.data)
