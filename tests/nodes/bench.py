"""A bench for one node: its own context and executor, bounded spins, no launch system."""

import gc
import time
from collections.abc import Callable, Sequence

import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy


class Bench:
    """Nodes under test, and one node that talks to them; ROS arguments are for all of them."""

    def __init__(self, args: Sequence[str] = ()) -> None:
        self.context = Context()
        rclpy.init(context=self.context, args=list(args))
        self.executor = SingleThreadedExecutor(context=self.context)
        self._nodes: list[Node] = []
        self._has_refused = False
        self.peer = self.add(Node("bench", context=self.context))

    def add(self, node: Node) -> Node:
        self._nodes.append(node)
        self.executor.add_node(node)
        return node

    def make(self, node_class: type, **parameters: object) -> Node:
        """A node under test with these parameters."""
        overrides = [Parameter(name, value=value) for name, value in parameters.items()]
        try:
            return self.add(node_class(context=self.context, parameter_overrides=overrides))
        except Exception:
            self._has_refused = True
            raise

    def collect(self, message_type: type, topic: str, *, latched: bool = False) -> list:
        """A list that fills with what comes on ``topic``."""
        qos = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
        if latched:
            qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
        messages: list = []
        self.peer.create_subscription(message_type, topic, messages.append, qos)
        return messages

    def publisher(self, message_type: type, topic: str) -> object:
        """A publisher that has found the node under test."""
        publisher = self.peer.create_publisher(message_type, topic, 100)
        self.spin_until(lambda: publisher.get_subscription_count() > 0)
        return publisher

    def spin_until(self, condition: Callable[[], bool], limit: float = 30.0) -> None:
        """Spin until the condition holds; fail after ``limit`` seconds."""
        deadline = time.monotonic() + limit
        while not condition():
            assert time.monotonic() < deadline, "what the test waits for did not happen"
            self.executor.spin_once(timeout_sec=0.05)

    def spin_for(self, turns: int) -> None:
        """So many turns of the executor, to let anything unwanted happen."""
        for _ in range(turns):
            self.executor.spin_once(timeout_sec=0.01)

    def close(self) -> None:
        for node in self._nodes:
            self.executor.remove_node(node)
            node.destroy_node()
        self.executor.shutdown()
        self.context.try_shutdown()
        if self._has_refused:
            gc.collect()  # what is left of such a node would be seen on its domain


def pose_at(z: float, second: int, *, frame: str = "patient", **fields: float) -> PoseStamped:
    """A pose of the probe ``z`` m below the skin, stamped with a whole second."""
    message = PoseStamped()
    message.header.frame_id = frame
    message.header.stamp = Time(sec=second, nanosec=0)
    message.pose.position.x = fields.get("x", 0.0)
    message.pose.position.z = z
    message.pose.orientation.w = fields.get("w", 1.0)
    return message
