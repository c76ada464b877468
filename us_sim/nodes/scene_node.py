"""A node of a scene: its parameters, its health, lockstep or live input; who moves the probe."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.qos import QoSProfile

from us_sim.nodes.guarded_node import GuardedNode, Health, decoded
from us_sim.nodes.parameters import declared
from us_sim.nodes.qos import EVERY, STREAM
from us_sim.nodes.settings import VIEWER, SceneNodeSettings
from us_sim.scene.reading import load_scene
from us_sim.scene.scene import Scene


class Newest:
    """A subscription callback that hands ``work`` the newest message once the queue is drained.

    An executor takes one message of a subscription per turn, so working in the callback would
    fall behind a fast publisher. The callback therefore only stores, and a guard condition works
    in the first turn that brought nothing new. In lockstep every message is worked on at once.
    """

    def __init__(
        self, node: GuardedNode, health: Health, work: Callable[[Any], None], *, lockstep: bool
    ) -> None:
        self._node = node
        self._health = health
        self._work = work
        self._lockstep = lockstep
        self._waiting: Any = None
        self._arrived = 0  # ns of the monotonic clock
        self._fresh = False
        self._guard = node.create_guard_condition(self._turn)

    def __call__(self, message: Any) -> None:
        """Take a message from the subscription."""
        self._health.received += 1
        if self._lockstep:
            self._work(message)
            return
        if self._waiting is not None:
            self._health.dropped += 1
        self._waiting, self._arrived = message, time.monotonic_ns()
        self._fresh = True
        self._guard.trigger()

    def _turn(self) -> None:
        if self._fresh:
            self._fresh = False
            self._guard.trigger()
            return
        message, self._waiting = self._waiting, None
        if message is not None:
            self._node.arrived = self._arrived
            self._work(message)


class SceneNode(GuardedNode):
    """A node that works on a scene.

    Its parameters are those of `SceneNodeSettings`.
    """

    def __init__(self, name: str, **kwargs: Any) -> None:
        super().__init__(name, **kwargs)
        settings = declared(self, SceneNodeSettings())
        self.scene: Scene = load_scene(settings.scene, volume=settings.volume)
        self.lockstep = settings.lockstep
        self.threads = settings.threads
        #: Whether its process should go before ordinary ones.
        self.goes_first = settings.realtime and not settings.lockstep
        self.health: Health = Health(self, self.scene.name)

    def newest(
        self,
        message_type: Any,
        topic: str,
        work: Callable[[Any], None],
        qos: QoSProfile | None = None,
    ) -> None:
        """Call ``work`` with the newest message of ``topic`` (with each one in lockstep).

        What is skipped is not even decoded.
        """
        guarded = self.guarded(self.resolve_topic_name(topic), decoded(message_type, work))
        newest = Newest(self, self.health, guarded, lockstep=self.lockstep)
        self.listen(message_type, topic, newest, qos, raw=True)

    def listen(
        self,
        message_type: Any,
        topic: str,
        callback: Callable[[Any], None],
        qos: QoSProfile | None = None,
        **options: Any,
    ) -> None:
        """Subscribe to every message of ``topic``."""
        qos = qos or (EVERY if self.lockstep else STREAM)
        self.create_subscription(message_type, topic, callback, qos, **options)


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
