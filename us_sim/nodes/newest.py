"""Newest wins: a live consumer works on the last message that came and counts those it skipped."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.health import Health


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
