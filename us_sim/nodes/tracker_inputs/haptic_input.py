"""A haptic arm's handle, as its driver reports it up to a thousand times a second."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geometry_msgs.msg import PoseStamped
from std_msgs.msg import Bool

from us_sim.tracking.haptic.device import HapticDevice
from us_sim.tracking.haptic.settings import HapticSettings

if TYPE_CHECKING:
    from us_sim.nodes.probe_tracker import ProbeTracker

__all__ = ["HapticInput"]


class HapticInput:
    """``haptic/pose`` in the frame that the scene names; ``haptic/clutch`` holds the probe."""

    def __init__(self, node: ProbeTracker) -> None:
        self._node = node
        self._device = HapticDevice(node.scene.tracker.haptic or HapticSettings())
        node.listen_to_device(PoseStamped, "haptic/pose", self._take)
        node.listen_to_device(Bool, "haptic/clutch", self._clutch)

    def _take(self, message: PoseStamped) -> None:
        pose = self._node.pose_in(message, "haptic/pose")
        if pose is None:
            return
        stamp = self._node.stamp_of(message.header, "haptic/pose")
        self._node.take(self._device.take(pose, stamp))

    def _clutch(self, message: Bool) -> None:
        self._device.clutch(message.data)
