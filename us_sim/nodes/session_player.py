"""A player of whole recordings, for RViz or Foxglove."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rclpy.exceptions import NameValidationException
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile

from us_sim.errors import BagError
from us_sim.nodes.process import node_main
from us_sim.nodes.sessions.playback import RecordingPlayer
from us_sim.nodes.sessions.recorded_topic import message_type
from us_sim.nodes.settings import SessionPlayerSettings
from us_sim.recording.reader import read_bag
from us_sim.recording.topic import BagMessage, BagTopic

DEPTH = 10  # messages that publishers keep
START_S = 0.5  # for subscribers to find the publishers before the first message
_SHOWN = 100_000_000  # ns of a recording that are published at once after a jump


class SessionPlayer(RecordingPlayer):
    """Every topic of a bag, its bytes and stamps untouched, in the recorded order and pace."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("session_player", SessionPlayerSettings(), **kwargs)
        settings = self.settings
        self._bag = read_bag(self.path)
        self.first = self._bag.start or 0
        self.length = (self._bag.end or 0) - self.first
        self._topics: dict[str, Publisher] = {}
        self._latched: set[str] = set()  # of them
        exclude = {*map(self.resolve_topic_name, filter(None, settings.exclude))}
        exclude |= {"/clock"} if settings.clock else set()
        offered = [topic for topic in self._bag.topics if topic.name not in exclude]
        left_out = [why for topic in offered if (why := self._offer(topic))]
        if not any(self._bag.find_topic(name).message_count for name in self._topics):
            why = "; ".join(left_out) or "no topic of it has a message"
            raise BagError(f"{self.path} holds nothing that can be played: {why}")
        if left_out:
            self.health.warning = f"{'; '.join(left_out)}: left out"
            self.get_logger().warning(self.health.warning)
        if self._bag.fault:
            self.get_logger().warning(self._bag.fault)
        self._messages: Iterator[BagMessage] = iter(())
        self._waiting: BagMessage | None = None
        self._shown = -1  # ns of the recording that are published even if it is paused
        self._start = self.create_timer(START_S, self._begin)

    def _offer(self, topic: BagTopic) -> str:
        if topic.encoding != "cdr":
            return f"{topic.name} ({topic.encoding} is not CDR)"
        try:
            kind = message_type(topic.type_name)
        except BagError as error:
            return f"{topic.name} ({error})"
        latched = topic.is_latched
        if latched:
            self._latched.add(topic.name)
        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        try:
            qos = QoSProfile(depth=DEPTH, durability=durability)
            self._topics[topic.name] = self.create_stream_publisher(kind, topic.name, qos)
        except (NameValidationException, ValueError):
            return f"{topic.name!r} (no topic of ROS 2 is called so)"
        return ""

    def _begin(self) -> None:
        if not self.now:
            return
        self._start.cancel()
        self._play()
        sought = round(1e9 * self.settings.time)
        self.go_to(sought, None if sought else self.now)
        self.create_timer(0.002, self.play_on)
        self.begin_playing()

    def send_due(self) -> bool:
        """Send the messages that are due; while it is paused only those after a jump."""
        elapsed = self._shown
        if not self.settings.paused:
            elapsed = max(elapsed, self.head.compute_position(self.now))
        while self._waiting is not None and self._waiting.log_time - self.first <= elapsed:
            self._send(self._waiting)
        return self._waiting is None and not self.settings.paused

    def _send(self, message: BagMessage) -> None:
        self._topics[message.topic].publish(message.data)
        self.health.count_published(message.topic)
        self._waiting = self._next()

    def go_to(self, position: int, at: int | None = None) -> None:
        """Play on from a position; without a time ``at``, show a moment of it even if paused.

        The last latched messages before it are sent again.
        """
        self.damage.clear()
        since = self.first + position if position > 0 else None
        if since is not None:
            for message in self._bag.read_latest(self._latched, since, DEPTH):
                self._topics[message.topic].publish(message.data)
        self._messages = iter(self._bag.read_messages(list(self._topics), self.damage, since))
        self._waiting = self._next()
        self._shown = position + _SHOWN if position and at is None else -1
        self.head.go_to(position, self.now if at is None else at)

    def _next(self) -> BagMessage | None:
        """Return the next message, or None; report damaged parts, and skip them if possible."""
        known = len(self.damage)
        try:
            message = next(self._messages, None)
        except BagError as error:
            self.damage.append(str(error))
            message = None
        for fault in self.damage[known:]:
            self.health.count_problem("damage", fault)
        return message


main = node_main(SessionPlayer, __name__)
