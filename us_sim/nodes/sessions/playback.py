"""Playing a recording: waiting for whoever needs it, rate, pause and place."""

from __future__ import annotations

import time
from abc import abstractmethod
from typing import Any

from builtin_interfaces.msg import Time as TimeMessage
from rclpy.clock import Clock
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.task import Future
from rosgraph_msgs.msg import Clock as ClockMessage

from us_sim.errors import BagError
from us_sim.nodes.guarded_node import GuardedNode, Health
from us_sim.nodes.messages import stamp_message
from us_sim.nodes.parameters import Group, LiveSettings
from us_sim.nodes.sessions.triggers import offer
from us_sim.nodes.settings import RECORDER, PathPlayerSettings, PlayerSettings
from us_sim.recording.playhead import Playhead
from us_sim.share import find_bag

CHECK_S, CHECKS = 0.05, 6
"""How often it is looked, and how often in a row everything must be there.

A best-effort subscriber may find a publisher a little later than it is found itself.
"""
TELL_AFTER_S = 5.0  # after so long it is said what is waited for


class Awaited:
    """Waits for the topics that a path player's settings name, and for a subscriber.

    After a while what is missing is said, and told in diagnostics as ``awaited``.

    Args:
        node: that plays.
        publisher: to which somebody must have subscribed.
        settings: of the node.
    """

    def __init__(
        self, node: GuardedNode, publisher: Publisher, settings: PathPlayerSettings
    ) -> None:
        self._node, self._publisher, self._settings = node, publisher, settings
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
            topic = node.resolve_topic_name(topic)
            if not node.count_publishers(topic):
                return f"{topic} to be published"
        for topic in map(node.resolve_topic_name, self._settings.await_recorded):
            listeners = node.get_subscriptions_info_by_topic(topic)
            if RECORDER not in {info.node_name for info in listeners}:
                return f"{RECORDER} to subscribe to {topic}"
        return ""


class Player(GuardedNode):
    """Does as the parameters of a player say, and its service ``~/stop``.

    It publishes ``/clock`` where its parameter ``clock`` asks for that, and then goes by the
    computer's clock itself; else by its node's, also where that is set back.

    Args:
        name: of the node.
        settings: its parameters by default.
    """

    def __init__(self, name: str, settings: PlayerSettings, **kwargs: Any) -> None:
        super().__init__(name, **kwargs)
        self._live = LiveSettings(self, {"player": Group(settings)}, use=lambda _: self.use())
        chosen = self.settings
        if not chosen.path:
            raise BagError(f"{name}'s parameter `path` is missing; name a bag to play")
        self.path = find_bag(chosen.path)
        self.finished = Future()
        self.health = Health(self, str(self.path))
        self.head = Playhead(chosen.rate)
        self.first = self.length = 0  # ns: since 1970 when it was recorded, and how long it is
        self.has_begun = self.is_stopped = False
        self._latest = 0  # ns, of `now`
        self.clock = Clock() if chosen.clock else self.get_clock()
        if chosen.clock:
            self._clock_messages = self.stream(ClockMessage, "/clock")
            self.create_timer(1.0 / chosen.clock, self.tell_time)
        self.add_post_set_parameters_callback(self._seek)
        if not getattr(chosen, "lockstep", False):
            offer(self, "stop", self._stop)

    @property
    def settings(self) -> Any:
        """Its parameters as they are now, of the class of those by default."""
        return self._live.values["player"]

    @abstractmethod
    def go_to(self, position: int, at: int | None = None) -> None:
        """Play on at a time of the recording, ns, from a time of `now` on.

        Without that it plays on at once, and shows what is there even if it is paused.
        """

    @abstractmethod
    def say_progress(self) -> None:
        """Put into the node's health how far it is."""

    @abstractmethod
    def end(self) -> None:
        """Be at the end."""

    @property
    def now(self) -> int:
        """ns, of the clock that the player goes by; 0 where simulated time has not begun."""
        now = int(self.clock.now().nanoseconds)
        if now < self._latest:
            self.head.go_to(self.head.position(self._latest), now)
        self._latest = now
        return now

    @property
    def position(self) -> int:
        """ns from the recording's start, within it."""
        return min(max(self.head.position(self.now), 0), self.length)

    def tell_time(self) -> TimeMessage:
        """Return the present time: of the recording where ``/clock`` is, which is published."""
        if not self.settings.clock:
            return self.get_clock().now().to_msg()
        stamp = stamp_message(self.first + self.position)
        if self.has_begun:
            self._clock_messages.publish(ClockMessage(clock=stamp))
        return stamp

    def begin(self) -> None:
        """Obey parameters from now on, and those that are set already."""
        self.has_begun = True
        self.use()

    def use(self) -> None:
        """Go on at the rate that was set, or hold still; before it began there is nothing to do."""
        if not self.has_begun:
            return
        settings = self.settings
        self.head.run_at(settings.rate, self.now)
        self.head.hold(settings.paused, self.now)
        if self.health.state != "finished" or self.loops:
            self._play()
        self._report()

    @property
    def loops(self) -> bool:
        """Whether it begins again at the end."""
        return bool(self.settings.loop) and not self.is_stopped

    def restart(self, gap: int = 0) -> None:
        """Play from the start on, after a gap, ns."""
        self._play()
        self.go_to(0, self.now + gap)

    def finish(self) -> None:
        """Say that it is at its end."""
        self.health.state = "finished"
        self._report()

    def _play(self) -> None:
        self.health.state = "paused" if self.settings.paused else "playing"

    def _stop(self) -> str:
        if not self.has_begun or self.health.state == "finished":
            return "nothing is played"
        self.is_stopped = True
        self.end()
        return ""

    def _seek(self, parameters: list[Parameter]) -> None:
        """Continue at a time, whenever it is set, even to the same value."""
        times = [round(1e9 * each.value) for each in parameters if each.name == "time"]
        if not self.has_begun or not times:
            return
        self.is_stopped = False
        self.go_to(times[-1])
        self._play()
        self._report()

    def _report(self) -> None:
        self.say_progress()
        self.health.report()
