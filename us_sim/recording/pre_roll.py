"""The last messages before somebody asks for them, kept in memory.

>>> from us_sim.recording.write_behind import Message
>>> kept = PreRoll(max_bytes=1000, duration=2.0)
>>> for second in range(5):
...     kept.add(Message("/note", b"....", log_time=second * 10**9, publish_time=0))
>>> [message.log_time // 10**9 for message in kept.take()]
[2, 3, 4]
>>> kept.take()
[]
"""

from __future__ import annotations

from collections import deque

from us_sim.recording.write_behind import Message


class PreRoll:
    """A ring of messages, as rosbag2's snapshot mode keeps it.

    Of a latched topic the newest message is kept whatever its age: a late listener would get it,
    and what is recorded makes no sense without it.

    Args:
        max_bytes: of messages; the oldest go.
        duration: s before the newest message's; 0 for any.
    """

    def __init__(self, max_bytes: int, duration: float = 0.0) -> None:
        self._max_bytes, self._duration = max_bytes, round(duration * 1e9)
        self._ring: deque[Message] = deque()
        self._bytes = 0
        self._latched: dict[str, Message] = {}

    def add(self, message: Message, *, latched: bool = False) -> None:
        """Keep a message, and let go of what is too old or too much."""
        if latched:
            before = self._latched.get(message.topic)
            self._latched[message.topic] = message
            if before is None:
                return
            message = before
        self._ring.append(message)
        self._bytes += len(message.data)
        oldest = message.log_time - self._duration if self._duration else 0
        while self._ring and (self._bytes > self._max_bytes or self._ring[0].log_time < oldest):
            self._bytes -= len(self._ring.popleft().data)

    def take(self) -> list[Message]:
        """What is kept, by its time; nothing is kept afterwards."""
        messages = sorted([*self._latched.values(), *self._ring], key=lambda each: each.log_time)
        self._ring.clear()
        self._latched.clear()
        self._bytes = 0
        return messages
