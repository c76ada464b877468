"""Newest wins: a live consumer works on the last message that came and counts those it skipped."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node

from us_sim.nodes.health import Health

__all__ = ["Newest"]


class Newest:
    """A subscription callback that hands ``work`` the newest message once the queue is drained.

    An executor takes one message of a subscription per turn, so working in the callback would
    fall behind a fast publisher. The callback therefore only stores, and a guard condition works
    in the first turn that brought nothing new. In lockstep every message is worked on at once.
    """

    def __init__(
        self, node: Node, health: Health, work: Callable[[Any], None], *, lockstep: bool
    ) -> None:
        self._health = health
        self._work = work
        self._lockstep = lockstep
        self._waiting: Any = None
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
        self._waiting = message
        self._fresh = True
        self._guard.trigger()

    def _turn(self) -> None:
        if self._fresh:
            self._fresh = False
            self._guard.trigger()
            return
        message, self._waiting = self._waiting, None
        if message is not None:
            self._work(message)
