"""Work that another thread has a node do in the thread that spins it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, TypeVar

from rclpy.node import Node

T = TypeVar("T")


class Posted:
    """Runs calls from any thread in the node's thread, in order.

    Args:
        node: that is spun.
    """

    def __init__(self, node: Node) -> None:
        self._work: deque[tuple[Callable[[], Any], Future[Any]]] = deque()
        self._guard = node.create_guard_condition(self._turn)
        self._closed = False

    def __call__(self, work: Callable[[], T]) -> Future[T]:
        """Run it soon; the future holds its result or exception."""
        future: Future[T] = Future()
        if self._closed:
            future.cancel()
            return future
        self._work.append((work, future))
        self._guard.trigger()
        return future

    def close(self) -> None:
        """Cancel all waiting calls, as the node ends."""
        self._closed = True
        while self._work:
            self._work.popleft()[1].cancel()

    def _turn(self) -> None:
        for _ in range(len(self._work)):
            work, future = self._work.popleft()
            if not future.set_running_or_notify_cancel():
                continue
            try:
                future.set_result(work())
            except Exception as error:
                future.set_exception(error)
