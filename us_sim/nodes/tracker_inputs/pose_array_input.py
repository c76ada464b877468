"""One body of a tracker that sends all of its bodies in one message."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geometry_msgs.msg import PoseArray, PoseStamped

from us_sim.tracking.measurement import Measurement

if TYPE_CHECKING:
    from us_sim.nodes.probe_tracker import ProbeTracker

__all__ = ["PoseArrayInput"]


class PoseArrayInput:
    """The pose ``tracker.entry`` of ``tracker/poses``, in the frame that the scene names."""

    def __init__(self, node: ProbeTracker) -> None:
        self._node = node
        self._entry = node.scene.tracker.entry
        node.listen_to_device(PoseArray, "tracker/poses", self._take)

    def _take(self, message: PoseArray) -> None:
        if self._entry >= len(message.poses):
            self._node.refuse(
                "entry",
                f"tracker/poses holds {len(message.poses)} poses, so none is number {self._entry} "
                f"(from 0): set tracker.entry in the scene",
            )
            return
        entry = PoseStamped(header=message.header, pose=message.poses[self._entry])
        pose = self._node.pose_in(entry, "tracker/poses")
        if pose is not None:
            self._node.take(Measurement(self._node.stamp_of(message.header, "tracker/poses"), pose))
