"""Whether the probe's pose is live, stale or lost."""

from __future__ import annotations

from builtin_interfaces.msg import Time as TimeMessage
from rclpy.node import Node
from rclpy.time import Time

from us_sim.nodes.parameters import Group, LiveSettings
from us_sim.nodes.settings import PoseAgeSettings

__all__ = ["PoseAge"]


class PoseAge:
    """How long ago the newest pose was taken, and what that makes of an image at it.

    A pose ages by its stamp, and from its arrival too, so that a tracker whose clock is ahead
    does not look live when it has gone. How long is too long are the parameters of
    `PoseAgeSettings`.

    Args:
        node: whose clock is used, and which gets the parameters.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._stamp: int | None = None  # ns, of the newest pose
        self._arrived = 0  # ns
        self._settings = LiveSettings(node, {"age": Group(PoseAgeSettings())})

    def came(self, stamp: TimeMessage) -> None:
        """A pose with that stamp has come."""
        self._stamp = Time.from_msg(stamp).nanoseconds
        self._arrived = self._now()

    @property
    def pose(self) -> float | None:
        """Age of the newest pose, s; None before the first."""
        if self._stamp is None:
            return None
        now = self._now()
        self._arrived = min(self._arrived, now)  # time may be set back, as when a bag starts again
        return 1e-9 * max(now - self._stamp, now - self._arrived)

    def image(self, stamp: TimeMessage) -> float:
        """Age of an image of the pose with that stamp, s: at least that of the newest pose."""
        return max(self.pose or 0.0, 1e-9 * (self._now() - Time.from_msg(stamp).nanoseconds))

    def word(self, age: float | None) -> str:
        """``live``, ``stale``, ``lost``, or ``waiting`` for the first."""
        if age is None:
            return "waiting"
        limits = self._settings.values["age"]
        if age > limits.lost_after:
            return "lost"
        return "stale" if age > limits.stale_after else "live"

    def _now(self) -> int:
        return int(self._node.get_clock().now().nanoseconds)
