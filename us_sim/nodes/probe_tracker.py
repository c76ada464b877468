"""Validates the tracker's poses and forwards them as the probe's."""

from __future__ import annotations

import sys
from typing import Any

from geometry_msgs.msg import PoseStamped
from rclpy.time import Time
from tf2_msgs.msg import TFMessage

from us_sim.errors import PoseError
from us_sim.nodes.conversions import pose_from, pose_message, transform_message
from us_sim.nodes.process import run_node
from us_sim.nodes.qos import EVERY, FOREIGN
from us_sim.nodes.scene_node import SceneNode

__all__ = ["ProbeTracker", "main"]

RESTART_NS = 1_000_000_000
"""A stamp that jumps back by more is a restarted source, not a late message."""


class ProbeTracker(SceneNode):
    """``tracker/pose`` in, ``probe/pose`` and ``tf`` out."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("probe_tracker", **kwargs)
        self._frame = self.scene.tracker.frame
        self._last_stamp = 0
        self._poses = self.stream(PoseStamped, "probe/pose")
        self._transforms = self.stream(TFMessage, "tf")
        self.listen(PoseStamped, "tracker/pose", self._take, EVERY if self.lockstep else FOREIGN)
        self.health.state = "waiting for poses"

    def _take(self, message: PoseStamped) -> None:
        self.health.received += 1
        if message.header.frame_id != self._frame:
            self.health.problem(
                "frame",
                f"tracker/pose is in frame '{message.header.frame_id}', not '{self._frame}': "
                f"set the tracker's frame, or tracker.frame in the scene",
            )
            return
        try:
            pose = pose_from(message)
        except PoseError as error:
            self.health.problem("pose", f"tracker/pose: {error}; it is not used")
            return
        if not self._in_order(message):
            return
        stamp = message.header.stamp
        self._poses.publish(pose_message(pose, stamp, self._frame))
        self.health.published("probe/pose", stamp)
        if self._transforms.get_subscription_count():
            transform = transform_message(pose, stamp, self._frame, "probe")
            self._transforms.publish(TFMessage(transforms=[transform]))
            self.health.published("tf")
        self.health.state = "tracking"

    def _in_order(self, message: PoseStamped) -> bool:
        """Whether the stamp is new; an unstamped pose is stamped with its arrival."""
        stamp = Time.from_msg(message.header.stamp).nanoseconds
        if stamp == 0:
            now = self.get_clock().now()
            message.header.stamp = now.to_msg()
            stamp = now.nanoseconds
            self.health.problem("stamp", "tracker/pose has no stamp: its time of arrival is used")
        step = stamp - self._last_stamp
        if self._last_stamp and -RESTART_NS < step <= 0:
            self.health.problem(
                "order", "tracker/pose is not newer than the pose before it; it is not used"
            )
            return False
        if step <= -RESTART_NS:
            self.get_logger().info(f"tracker/pose starts again {-step * 1e-9:.3f} s earlier")
        self._last_stamp = stamp
        return True


def main(args: list[str] | None = None) -> int:
    """Run the node until it is interrupted."""
    return run_node(ProbeTracker, args)


if __name__ == "__main__":
    sys.exit(main())
