"""Whether the probe's pose is live, stale or lost."""

from __future__ import annotations

import time

from builtin_interfaces.msg import Time as TimeMessage

from us_sim.nodes.conversions import nanoseconds_of
from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.image_settings import PoseAgeSettings
from us_sim.nodes.parameters import Group, LiveSettings

REMEMBERED = 256
"""Poses whose arrival is kept for the images at them."""


class PoseAge:
    """How long ago the newest pose came, and what that makes of an image at it.

    A pose ages from its arrival: its stamp may be of another clock, such as that of a tracker
    which is ahead, or of the day it was recorded. It ages while ROS's time goes on, and never by
    more than has really passed: that time may be set, and stands still while a bag is paused. How
    long is too long are the parameters of `PoseAgeSettings`.

    Args:
        node: whose clock is used, and which gets the parameters.
    """

    def __init__(self, node: GuardedNode) -> None:
        self._node = node
        self._arrivals: dict[int, tuple[int, int]] = {}  # ns, as `_now`, by stamps in ns
        self._settings = LiveSettings(node, {"age": Group(PoseAgeSettings())})

    def came(self, stamp: TimeMessage) -> None:
        """A pose with that stamp has come."""
        nanoseconds = nanoseconds_of(stamp)
        self._arrivals.pop(nanoseconds, None)  # so that the newest comes last
        self._arrivals[nanoseconds] = self._now()
        if len(self._arrivals) > REMEMBERED:
            del self._arrivals[next(iter(self._arrivals))]

    @property
    def pose(self) -> float | None:
        """Age of the newest pose, s; None before the first."""
        if not self._arrivals:
            return None
        newest = next(reversed(self._arrivals))
        return self._since(newest)

    def image(self, stamp: TimeMessage) -> float:
        """Age of an image of the pose with that stamp, s, or of the oldest that is remembered."""
        if not self._arrivals:
            return 0.0
        nanoseconds = nanoseconds_of(stamp)
        known = nanoseconds in self._arrivals
        return self._since(nanoseconds if known else next(iter(self._arrivals)))

    def word(self, age: float | None) -> str:
        """``live``, ``stale``, ``lost``, or ``waiting`` for the first."""
        if age is None:
            return "waiting"
        limits = self._settings.values["age"]
        if age > limits.lost_after:
            return "lost"
        return "stale" if age > limits.stale_after else "live"

    def _since(self, stamp: int) -> float:
        """s since the pose with that stamp came."""
        now, real = self._now()
        came, really = self._arrivals[stamp]
        if came > now:  # time was set back, as when a bag starts again
            self._arrivals[stamp] = came, really = now, real
        return 1e-9 * min(now - came, real - really)

    def _now(self) -> tuple[int, int]:
        """ns of ROS's time, and of one that nobody sets."""
        return int(self._node.get_clock().now().nanoseconds), time.monotonic_ns()
