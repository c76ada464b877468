"""The newest value of a device's thread, for the node's own."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

from us_sim.nodes.guarded_node import GuardedNode

T = TypeVar("T")


class Mailbox(Generic[T]):
    """Hands the newest value of another thread to the node's; one that is overtaken is dropped.

    Args:
        node: counts what comes, and what is dropped.
        use: called with the value in the node's thread.
        where: what a person knows the thread by.
    """

    def __init__(self, node: GuardedNode, use: Callable[[T], None], where: str) -> None:
        self._node, self._use, self._where = node, use, where
        self._newest: deque[T] = deque(maxlen=1)

    def put(self, value: T) -> None:
        """Keep a value, in place of one that was not used yet."""
        self._node.health.received += 1
        self._node.health.dropped += len(self._newest)
        self._newest.append(value)
        self._node.call_soon(self._use_newest, self._where)

    def _use_newest(self) -> None:
        if self._newest:
            self._use(self._newest.pop())
