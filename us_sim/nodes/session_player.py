"""Publishes a whole recording again, as it was: to look at it in RViz or Foxglove."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from typing import Any

from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.task import Future

from us_sim.errors import BagError
from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.health import Health
from us_sim.nodes.parameters import declared
from us_sim.nodes.process import run_node
from us_sim.nodes.settings import SessionPlayerSettings
from us_sim.recording.reader import read_bag
from us_sim.recording.topic import BagMessage, BagTopic

__all__ = ["SessionPlayer", "main"]

START_S = 0.5
"""For subscribers to find the publishers before the first message."""


class SessionPlayer(GuardedNode):
    """Every topic of a bag, its bytes and stamps untouched, in the recorded order and pace.

    Its parameters are those of `SessionPlayerSettings`.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("session_player", **kwargs)
        settings = declared(self, SessionPlayerSettings())
        path, self._rate, self._loop = settings.path, settings.rate, settings.loop
        if not path:
            raise BagError("session_player's parameter `path` is missing; name a bag to play")
        self._bag = read_bag(path)
        self.finished = Future()
        self.health = Health(self, str(path))
        self._topics: dict[str, Publisher] = {}
        for topic in self._bag.topics:
            self._offer(topic)
        self._messages: Iterator[BagMessage] = iter(())
        self._waiting: BagMessage | None = None
        self._begun = 0
        self._first = 0
        self._start = self.create_timer(START_S, self._begin)

    def _offer(self, topic: BagTopic) -> None:
        if topic.encoding != "cdr":
            self.health.problem("topic", f"{topic.name} is left out: {topic.encoding} is not CDR")
            return
        package, _, name = topic.type_name.split("/")
        try:
            message_type = getattr(importlib.import_module(f"{package}.msg"), name)
        except (ImportError, AttributeError):
            self.health.problem(
                "topic", f"{topic.name} is left out: {topic.type_name} is not installed here"
            )
            return
        latched = _is_latched(topic)
        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        qos = QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=10,
            reliability=ReliabilityPolicy.RELIABLE,
            durability=durability,
        )
        self._topics[topic.name] = self.create_publisher(message_type, topic.name, qos)

    def _begin(self) -> None:
        self._start.cancel()
        self._messages = iter(self._bag.messages(list(self._topics)))
        self._waiting = next(self._messages, None)
        self._begun = self.get_clock().now().nanoseconds
        self._first = self._waiting.log_time if self._waiting else 0
        self.health.state = "playing"
        self.create_timer(0.002, self._tick)

    def _tick(self) -> None:
        """Send what is due."""
        elapsed = (self.get_clock().now().nanoseconds - self._begun) * self._rate
        while self._waiting is not None and self._waiting.log_time - self._first <= elapsed:
            self._topics[self._waiting.topic].publish(self._waiting.data)
            self.health.published(self._waiting.topic)
            self._waiting = next(self._messages, None)
        if self._waiting is not None or self.finished.done():
            return
        if self._loop:
            self._messages = iter(self._bag.messages(list(self._topics)))
            self._waiting = next(self._messages, None)
            self._begun = self.get_clock().now().nanoseconds
            return
        self.health.state = "finished"
        self.finished.set_result(None)


def _is_latched(topic: BagTopic) -> bool:
    return bool(topic.qos) and all(q.durability == "transient_local" for q in topic.qos)


def main(args: list[str] | None = None) -> int:
    """Play the recording, then end."""
    return run_node(SessionPlayer, args)


if __name__ == "__main__":
    sys.exit(main())
