"""Plays a recorded probe path as a tracker would."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from numpy.typing import NDArray
from rclpy.task import Future
from rclpy.time import Time
from sensor_msgs.msg import Image

from us_sim.errors import BagError
from us_sim.nodes.awaited import Awaited
from us_sim.nodes.conversions import nanoseconds_of, pose_message
from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.health import Health
from us_sim.nodes.parameters import declared
from us_sim.nodes.process import run_node
from us_sim.nodes.qos import EVERY, STREAM, overridable
from us_sim.nodes.settings import PathPlayerSettings
from us_sim.recording.path import ProbePath, read_path

__all__ = ["PathPlayer", "main"]

CHECK_S, CHECKS = 0.05, 6
"""How often, and how often in a row, everything awaited must be there before the first pose."""


class PathPlayer(GuardedNode):
    """A bag's poses on ``tracker/pose``.

    Its parameters are those of `PathPlayerSettings` and `AwaitedSettings`.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("path_player", **kwargs)
        settings = declared(self, PathPlayerSettings())
        path = settings.path
        self._rate, self._loop = settings.rate, settings.loop
        self._restamp, self._lockstep = settings.restamp, settings.lockstep
        self._awaited = Awaited(self)
        if not path:
            raise BagError("path_player's parameter `path` is missing; name a bag to play")
        self._path = read_path(path, settings.topic, option="its parameter `topic`")
        self._stamps = _rising_stamps(self._path) if self._lockstep else self._path.stamps
        self._next = 0
        self._begun = round(1e9 * settings.begun)  # ns
        self._half_period = 0.0
        self._checks = 0
        self.finished = Future()
        self.health = Health(self, str(path))
        qos = EVERY if self._lockstep else STREAM
        self._poses = self.create_publisher(
            PoseStamped, "tracker/pose", qos, qos_overriding_options=overridable()
        )
        if self._lockstep:
            self.create_subscription(
                Image, "ultrasound/image", self._imaged, EVERY, qos_overriding_options=overridable()
            )
        self.health.state = "waiting for the simulation"
        self._starting = self.create_timer(CHECK_S, self._begin)
        self.pose_count = len(self._path)
        self.get_logger().info(f"{self.pose_count} poses of {self._path.topic} in {path}")
        if self._path.note:
            self.get_logger().warning(self._path.note)

    def _begin(self) -> None:
        """Start once somebody listens and the awaited topics have been there for a while.

        A best-effort subscriber may find this publisher a little later than it is found itself.
        """
        there = self._poses.get_subscription_count() and self._awaited.are_there()
        self._checks = self._checks + 1 if there else 0
        if self._checks < CHECKS:
            return
        self._starting.cancel()
        self.health.state = "playing"
        if self._lockstep:
            self._send()
            return
        steps = np.diff(self._path.log_times)
        period = float(np.median(steps)) * 1e-9 / self._rate if len(steps) else 0.01
        self._half_period = 0.5e9 * period
        now = self.get_clock().now().nanoseconds
        if not 0 < self._begun < now:
            self._begun = now
        self._skip(now)
        self.get_logger().info(f"playing from pose {self._next}")
        self._say_progress()
        self.health.report()
        self.create_timer(max(period, 1e-4), self._tick)

    def _skip(self, now: int) -> None:
        """Go where a path that began earlier is by now, ns: round and round if it loops."""
        ages = (self._path.log_times - self._path.log_times[0]) / self._rate
        turn = int(ages[-1] + 2 * self._half_period)
        if self._loop and turn > 0:
            self._begun += max(now - self._begun, 0) // turn * turn
        due = ages <= now - self._begun - self._half_period
        self._next = min(int(due.sum()), self.pose_count - 1)

    def _say_progress(self) -> None:
        """Tell diagnostics what it takes to go on from here in another process."""
        self.health.values = {"played": str(self._next), "begun": f"{1e-9 * self._begun:.9f}"}

    def _tick(self) -> None:
        """Send each pose whose time has come, to the nearest half period."""
        while not self.finished.done() and self._is_due():
            self._send()
            self._advance()

    def _is_due(self) -> bool:
        elapsed = self.get_clock().now().nanoseconds - self._begun + self._half_period
        times = self._path.log_times
        return bool((times[self._next] - times[0]) / self._rate <= elapsed)

    def _imaged(self, image: Image) -> None:
        stamp = nanoseconds_of(image.header.stamp)
        if stamp == self._stamps[self._next] and not self.finished.done():
            self._advance()
            if not self.finished.done():
                self._send()

    def _send(self) -> None:
        i = self._next
        pose = self._path.pose(i)
        restamp = self._restamp and not self._lockstep
        stamp = self.get_clock().now() if restamp else Time(nanoseconds=int(self._stamps[i]))
        self._poses.publish(pose_message(pose, stamp.to_msg(), self._path.frame_id))
        self.health.published("tracker/pose")

    def _advance(self) -> None:
        self._next += 1
        self._say_progress()
        if self._next < self.pose_count:
            return
        if self._loop:
            self._next = 0
            self._begun = self.get_clock().now().nanoseconds + int(2 * self._half_period)
            return
        self.health.state = "finished"
        self.get_logger().info("the path is at its end")
        self.finished.set_result(None)


def _rising_stamps(path: ProbePath) -> NDArray[np.int64]:
    """Stamps that tell the poses apart: their own, or else the times they were recorded at.

    Raises:
        BagError: neither rise from pose to pose.
    """
    for stamps in (path.stamps, path.log_times):
        if stamps[0] > 0 and (np.diff(stamps) > 0).all():
            return stamps
    raise BagError(
        f"{path.topic}: neither stamps nor log times rise from pose to pose, so lockstep cannot "
        f"tell the poses apart; record the path again"
    )


def main(args: list[str] | None = None) -> int:
    """Play the path, then end."""
    return run_node(PathPlayer, args)


if __name__ == "__main__":
    sys.exit(main())
