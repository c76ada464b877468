"""A node of a scene: its parameters, its health, lockstep or live input; who moves the probe."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

from us_sim.nodes.guarded_node import GuardedNode, Health
from us_sim.nodes.parameters import declared
from us_sim.nodes.process import COMPUTING
from us_sim.nodes.qos import EVERY, STREAM
from us_sim.nodes.settings import VIEWER, SceneNodeSettings
from us_sim.scene.reading import load_scene
from us_sim.scene.scene import Scene


class Overwritten:
    """Counts messages that a full queue has overwritten, by the numbers that a publisher gives.

    A callback of rclpy's EventsExecutor is not told a message's number, but one that is taken from
    a queue has it, and a queue that was full has several.

    >>> overwritten = Overwritten()
    >>> overwritten.received = 3
    >>> overwritten.count(3)  # the first number says nothing
    0
    >>> overwritten.received = 13
    >>> overwritten.count(20)
    7
    """

    def __init__(self) -> None:
        self.received = 0  # messages so far
        self._last: tuple[int, int] | None = None  # a number, and how many were received by then

    def count(self, number: int | None) -> int:
        """Return how many messages before this one were overwritten since the last number."""
        if number is None:  # not every middleware has them
            return 0
        last, self._last = self._last, (number, self.received)
        if last is None or number < last[0]:  # another publisher's
            return 0
        return max(number - last[0] - (self.received - last[1]), 0)


class SceneNode(GuardedNode):
    """A node that works on a scene.

    Its parameters are those of `SceneNodeSettings`.
    """

    live_priority = COMPUTING

    def __init__(self, name: str, **kwargs: Any) -> None:
        super().__init__(name, **kwargs)
        settings = declared(self, SceneNodeSettings())
        self.scene: Scene = load_scene(settings.scene, volume=settings.volume)
        self.lockstep = settings.lockstep
        self.threads = settings.threads
        is_realtime = settings.realtime and not settings.lockstep
        #: With which its process goes before ordinary ones; 0 is as one of them.
        self.realtime_priority = self.live_priority if is_realtime else 0
        self.health: Health = Health(self, self.scene.name)

    def newest(
        self,
        message_type: Any,
        topic: str,
        work: Callable[[Any], None],
        qos: QoSProfile | None = None,
    ) -> None:
        """Call ``work`` with the newest message of ``topic`` (with each one in lockstep).

        An executor takes one message of a subscription per turn, so a slow ``work`` would fall
        behind a fast publisher. What else waits is therefore taken here, and counted as dropped.
        """

        overwritten = Overwritten()

        def take(message: Any) -> None:
            self.health.received += 1
            overwritten.received += 1
            work(message if self.lockstep else self._take_last(subscription, message, overwritten))

        subscription = self.listen(message_type, topic, take, qos)

    def _take_last(self, subscription: Subscription, message: Any, overwritten: Overwritten) -> Any:
        """Take all that waits in a subscription's queue; return the last, else ``message``."""
        taken: Any = None
        with subscription.handle:
            for _ in range(subscription.qos_profile.depth):
                further = subscription.handle.take_message(subscription.msg_type, subscription.raw)
                if further is None:
                    break
                taken = further
                self.health.received += 1
                overwritten.received += 1
                self.health.dropped += 1
        if taken is None:
            return message
        message, info = taken
        lost = overwritten.count(info.get("publication_sequence_number"))
        if lost and self.count_publishers(subscription.topic_name) == 1:
            self.health.dropped += lost
        return message

    def listen(
        self,
        message_type: Any,
        topic: str,
        callback: Callable[[Any], None],
        qos: QoSProfile | None = None,
    ) -> Subscription:
        """Subscribe to every message of ``topic``."""
        qos = qos or (EVERY if self.lockstep else STREAM)
        subscription: Subscription = self.create_subscription(message_type, topic, callback, qos)
        return subscription


LEAD_TOPIC = "tracker/pose"
NO_PAGE = "no page moves the probe, and nobody else publishes tracker/pose"
NO_SENDER = "nobody publishes tracker/pose any more"


def poses_ended(node: GuardedNode) -> str:
    """Why no fault of a tracker keeps poses away, as where a path is at its end; empty if it may.

    Where pages could move the probe, it is that none is open.
    """
    name = node.resolve_topic_name(LEAD_TOPIC)
    hearers = [info.node_name for info in node.get_subscriptions_info_by_topic(name)]
    if "probe_tracker" not in hearers or node.count_publishers(name):
        return ""
    viewer = (VIEWER, node.get_namespace())
    return NO_PAGE if viewer in node.get_node_names_and_namespaces() else NO_SENDER
