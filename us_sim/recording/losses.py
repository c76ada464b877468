"""Messages that were not recorded, counted by topic and by where they were lost."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple


class Loss(NamedTuple):
    """Messages of one topic that were lost."""

    in_transport: int  # before they reached this process
    in_recorder: int  # since the queue or the disk was full


class Losses:
    """Counts what is lost, from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._in_transport: Counter[str] = Counter()
        self._in_recorder: Counter[str] = Counter()

    @property
    def total(self) -> int:
        """Messages of all topics."""
        with self._lock:
            return self._in_transport.total() + self._in_recorder.total()

    def add(self, topic: str, *, in_transport: int = 0, in_recorder: int = 0) -> None:
        """Some messages of a topic were lost."""
        with self._lock:
            self._in_transport[topic] += in_transport
            self._in_recorder[topic] += in_recorder

    def by_topic(self) -> dict[str, Loss]:
        """All that was lost so far, of topics that lost something."""
        with self._lock:
            topics = sorted({*+self._in_transport, *+self._in_recorder})
            return {t: Loss(self._in_transport[t], self._in_recorder[t]) for t in topics}


def news(now: Mapping[str, Loss], before: Mapping[str, Loss]) -> dict[str, Loss]:
    """What was lost between two looks at `Losses.by_topic`, of topics that lost something."""
    none = Loss(0, 0)
    return {
        topic: Loss(
            loss.in_transport - before.get(topic, none).in_transport,
            loss.in_recorder - before.get(topic, none).in_recorder,
        )
        for topic, loss in now.items()
        if loss != before.get(topic)
    }
