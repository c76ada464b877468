"""Where the probe is, whoever moves it, also for who begins to listen when nobody does any more."""

from __future__ import annotations

from collections.abc import Callable

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped

from us_sim.geometry.pose import Pose
from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.messages import pose_from, pose_from_text
from us_sim.nodes.qos import LATCHED, STREAM
from us_sim.tracking.measurement import TrackingState


class ProbeWhereabouts:
    """Each pose of ``probe/pose``, and the last one, which is in the latched ``probe/status``.

    Args:
        node: that listens.
        moved: called with each pose that comes, in frame ``patient``.
        rested: called when no more poses come, with the last and its stamp in ns; with None while
            there never was one.
        goes_on: called when poses come.
    """

    def __init__(
        self,
        node: GuardedNode,
        moved: Callable[[Pose], None],
        rested: Callable[[Pose | None, int], None],
        goes_on: Callable[[], None],
    ) -> None:
        self._node = node
        self._moved, self._rested, self._goes_on = moved, rested, goes_on
        self._heard = [
            node.create_subscription(PoseStamped, "probe/pose", self._follow, STREAM),
            node.create_subscription(DiagnosticStatus, "probe/status", self._find, LATCHED),
        ]

    @property
    def is_told(self) -> bool:
        """Whether there is somebody who says it."""
        return self._node.count_publishers(self._node.resolve_topic_name("probe/status")) > 0

    def close(self) -> None:
        """Listen no more."""
        for subscription in self._heard:
            self._node.destroy_subscription(subscription)
        self._heard = []

    def _follow(self, message: PoseStamped) -> None:
        self._moved(pose_from(message, "patient"))

    def _find(self, status: DiagnosticStatus) -> None:
        said = {each.key: each.value for each in status.values}
        if "pose" in said:
            stamp = said.get("stamp", "")
            self._rested(pose_from_text(said["pose"]), int(stamp) if stamp.isdecimal() else 0)
        elif status.message == TrackingState.WAITING.value:
            self._rested(None, 0)
        else:
            self._goes_on()
