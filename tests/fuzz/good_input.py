"""Messages of a good driver for a scene's tracker, so that images come of them."""

from __future__ import annotations

from typing import Any

from geometry_msgs.msg import Pose, PoseArray, PoseStamped, TransformStamped
from rclpy.node import Node
from sensor_msgs.msg import Joy
from std_msgs.msg import Bool

from us_sim.nodes.tf import TFMessage
from us_sim.scene.scene import Scene

__all__ = ["GoodInput", "good_input"]


class GoodInput:
    """Sends poses on one topic, with something before them where the source needs that.

    Args:
        node: that sends.
        scene: whose tracker gets them.
    """

    kind: Any = PoseStamped
    topic = "tracker/pose"

    def __init__(self, node: Node, scene: Scene) -> None:
        self._node, self._tracker = node, scene.tracker
        self._publisher = node.create_publisher(self.kind, self.topic, 10)

    def send(self, number: int) -> int:
        """Send the pose of that number; the stamp that its image will have, ns."""
        now = self._node.get_clock().now()
        message = self.message(1e-5 * (number % 100))
        for header in self.headers(message):
            header.stamp = now.to_msg()
            header.frame_id = self._tracker.frame
        self._publisher.publish(message)
        return int(now.nanoseconds) + round(1e9 * self._tracker.time_offset)

    def message(self, height: float) -> Any:
        """A message of the source's kind, from somewhere near z = 4 mm."""
        message = PoseStamped()
        message.pose.position.z = 0.004 + height
        return message

    def headers(self, message: Any) -> list[Any]:
        """Those that need a stamp and a frame."""
        return [message.header]


class _Haptic(GoodInput):
    topic = "haptic/pose"

    def __init__(self, node: Node, scene: Scene) -> None:
        super().__init__(node, scene)
        self._clutch = node.create_publisher(Bool, "haptic/clutch", 10)

    def send(self, number: int) -> int:
        self._clutch.publish(Bool(data=False))
        return super().send(number)


class _PoseArray(GoodInput):
    kind, topic = PoseArray, "tracker/poses"

    def message(self, height: float) -> PoseArray:
        message = PoseArray(poses=[Pose() for _ in range(self._tracker.entry + 1)])
        message.poses[-1].position.z = 0.004 + height
        return message


class _Mouse(GoodInput):
    kind, topic = Joy, "spacenav/joy"

    def message(self, height: float) -> Joy:  # noqa: ARG002 - it stays where it is
        return Joy(axes=[0.0] * 6, buttons=[0, 0])


class _Tf(GoodInput):
    kind, topic = TFMessage, "tf"

    def message(self, height: float) -> TFMessage:
        transform = TransformStamped(child_frame_id=self._tracker.body)
        transform.transform.translation.z = 0.004 + height
        return TFMessage(transforms=[transform])

    def headers(self, message: TFMessage) -> list[Any]:
        return [transform.header for transform in message.transforms]


_SOURCES = {
    "pose": GoodInput,
    "haptic": _Haptic,
    "pose_array": _PoseArray,
    "six_dof_mouse": _Mouse,
    "tf": _Tf,
}


def good_input(node: Node, scene: Scene) -> GoodInput | None:
    """That of the scene's source; None where it takes a device, a server or a camera's images."""
    kind = _SOURCES.get(scene.tracker.source.name)
    return None if kind is None else kind(node, scene)
