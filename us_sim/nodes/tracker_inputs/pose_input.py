"""Poses of any driver: NDI, OptiTrack, Vicon, a recorded path."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geometry_msgs.msg import PoseStamped

from us_sim.tracking.measurement import Measurement

if TYPE_CHECKING:
    from us_sim.nodes.probe_tracker import ProbeTracker

__all__ = ["PoseInput"]


class PoseInput:
    """``tracker/pose`` in the frame that the scene names."""

    def __init__(self, node: ProbeTracker) -> None:
        self._node = node
        node.listen_to_device(PoseStamped, "tracker/pose", self._take)

    def _take(self, message: PoseStamped) -> None:
        pose = self._node.pose_in(message, "tracker/pose")
        if pose is not None:
            self._node.take(Measurement(self._node.stamp_of(message.header, "tracker/pose"), pose))
