"""Playing a recording: waiting for whoever needs it, rate, pause and seeking."""

from __future__ import annotations

import time
from collections.abc import Callable

from rclpy.parameter import Parameter
from rclpy.publisher import Publisher

from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.parameters import declared
from us_sim.nodes.settings import (
    RECORDER,
    AwaitedSettings,
    PathPlayerSettings,
    SessionPlayerSettings,
)
from us_sim.recording.playhead import Playhead

CHECK_S, CHECKS = 0.05, 6
"""How often it is looked, and how often in a row everything must be there.

A best-effort subscriber may find a publisher a little later than it is found itself.
"""
TELL_AFTER_S = 5.0  # after so long it is said what is waited for


class Awaited:
    """Waits for the topics that `AwaitedSettings` name, and for a subscriber.

    After a while what is missing is said, and told in diagnostics as ``awaited``.

    Args:
        node: that plays.
        publisher: to which somebody must have subscribed.
    """

    def __init__(self, node: GuardedNode, publisher: Publisher) -> None:
        self._node, self._publisher = node, publisher
        self._settings = declared(node, AwaitedSettings())
        self._checks = 0
        self._since = 0.0  # s, monotonic; when it was first looked
        self._told = ""

    def has_come(self) -> bool:
        """Whether playing can begin; asked every `CHECK_S`."""
        missing = self._missing()
        self._checks = 0 if missing else self._checks + 1
        if self._checks >= CHECKS:
            self._node.health.values.pop("awaited", None)
            return True
        now = time.monotonic()
        self._since = self._since or now
        if missing and missing != self._told and now - self._since > TELL_AFTER_S:
            self._told = self._node.health.values["awaited"] = missing
            self._node.get_logger().warning(f"nothing is played yet: waiting for {missing}")
        return False

    def _missing(self) -> str:
        """The first that is not there; nothing when all are."""
        node = self._node
        if not self._publisher.get_subscription_count():
            return f"somebody to subscribe to {self._publisher.topic_name}"
        for topic in self._settings.await_topics:
            if not node.count_publishers(topic):
                return f"{node.resolve_topic_name(topic)} to be published"
        for topic in map(node.resolve_topic_name, self._settings.await_recorded):
            listeners = node.get_subscriptions_info_by_topic(topic)
            if RECORDER not in {info.node_name for info in listeners}:
                return f"{RECORDER} to subscribe to {topic}"
        return ""


class Playback:
    """Does as the parameters ``rate``, ``loop``, ``paused`` and ``time`` of a player say.

    Args:
        node: that plays; the state is told in its diagnostics.
        settings: gives them as they are now.
        go_to: has the node play on at a time of the recording, ns.
        say: puts into the node's health how far it is.
    """

    def __init__(
        self,
        node: GuardedNode,
        settings: Callable[[], PathPlayerSettings | SessionPlayerSettings],
        go_to: Callable[[int], None],
        say: Callable[[], None],
    ) -> None:
        self._node, self._settings, self._go_to, self._say = node, settings, go_to, say
        self.head = Playhead(settings().rate)
        self.has_begun = False
        node.add_post_set_parameters_callback(self._seek)

    @property
    def now(self) -> int:
        """ns, of the node's clock."""
        return int(self._node.get_clock().now().nanoseconds)

    def begin(self) -> None:
        """Parameters are obeyed from now on, and those that are set already."""
        self.has_begun = True
        self.use()

    def use(self) -> None:
        """Go on at the rate that was set, or hold still; before it began there is nothing to do."""
        if not self.has_begun:
            return
        settings = self._settings()
        self.head.run_at(settings.rate, self.now)
        self.head.hold(settings.paused, self.now)
        if self._node.health.state != "finished" or settings.loop:
            self._node.health.state = "paused" if settings.paused else "playing"
        self._report()

    def _seek(self, parameters: list[Parameter]) -> None:
        """Continue at a time, whenever it is set, even to the same value."""
        times = [round(1e9 * each.value) for each in parameters if each.name == "time"]
        if not self.has_begun or not times:
            return
        self._go_to(times[-1])
        self._node.health.state = "paused" if self._settings().paused else "playing"
        self._report()

    def _report(self) -> None:
        self._say()
        self._node.health.report()
