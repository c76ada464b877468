"""Plays a recorded probe path as a tracker would."""

from __future__ import annotations

import sys
import time
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from numpy.typing import NDArray
from rclpy.timer import Timer
from sensor_msgs.msg import Image

from us_sim.errors import BagError
from us_sim.nodes.messages import pose_message, stamp_message
from us_sim.nodes.process import MEASURING, run_node
from us_sim.nodes.qos import EVERY, SENT
from us_sim.nodes.sessions.playback import CHECK_S, Awaited, Player
from us_sim.nodes.settings import PathPlayerSettings
from us_sim.recording.decoding import nanoseconds_of
from us_sim.recording.path import ProbePath, read_path
from us_sim.settings.spelling import counted

HELD = 5.0
"""Poses a second of a probe that is held still; images are called stale after half a second."""


class PathPlayer(Player):
    """A bag's poses on ``tracker/pose``.

    Its parameters are those of `PathPlayerSettings`.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("path_player", PathPlayerSettings(), **kwargs)
        settings = self.settings
        self._path = read_path(self.path, settings.topic, option="its parameter `topic`")
        lockstep = settings.lockstep
        # It stands for a device, whose poses come regularly however busy the computer is.
        self.realtime_priority = 0 if lockstep else MEASURING
        self._stamps = _rising_stamps(self._path) if lockstep else self._path.stamps
        self._ages = self._path.log_times - self._path.log_times[0]  # ns
        self.first, self.length = int(self._path.log_times[0]), int(self._ages[-1])
        self._next, self._sent = 0, -1  # pose to be sent, and that which was sent last
        self._begun = round(1e9 * settings.begun)  # ns
        self._sent_at = 0.0  # s, of the monotonic clock
        self._poses = self.stream(PoseStamped, "tracker/pose", EVERY if lockstep else SENT)
        if lockstep:
            self.subscribe(Image, "ultrasound/image", self._on_image, EVERY)
        self._awaited = Awaited(self, self._poses, settings)
        self.health.state = "waiting"
        self._ticking = self._timer_at_its_pace()  # now, so that its thread goes first, too
        self._ticking.cancel()
        self._starting = self.create_timer(CHECK_S, self._begin)
        self.pose_count = len(self._path)
        self.get_logger().info(
            f"{counted(self.pose_count, 'pose')} of {self._path.topic} in {self.path}"
        )
        if self._path.note:
            self.get_logger().warning(self._path.note)

    def _begin(self) -> None:
        if not self._awaited.has_come() or not self.now:
            return
        self._starting.cancel()
        self.health.state = "playing"
        now = self.now
        if self.settings.lockstep:
            self.has_begun = True
            self.head.hold(True, now)
            self.go_to(round(1e9 * self.settings.time))
            return
        begun = self._begun if 0 < self._begun < now else now
        self.go_to(round(1e9 * self.settings.time), begun)
        self._skip(now)
        self.get_logger().info(f"playing from pose {self._next}")
        self._ticking.reset()
        self.begin()
        self._tick()

    def _timer_at_its_pace(self) -> Timer:
        period = max(1e-9 * self._period, 1e-4)
        timer: Timer = self.create_timer(period, self._tick, clock=self.clock)
        return timer

    @property
    def _period(self) -> float:
        """ns from pose to pose as they are played."""
        steps = np.diff(self._ages)
        return float(np.median(steps)) / self.settings.rate if len(steps) else 0.01e9

    def _skip(self, now: int) -> None:
        """Go where the playhead is by now; round and round if the path loops."""
        position = self.head.position(now)
        turn = int(self._ages[-1] + self._period * self.settings.rate)
        if self.settings.loop and 0 < turn < position:
            self.head.go_to(position % turn, now)
        due = self._ages <= self.head.position(now) - 0.5 * self._period * self.settings.rate
        self._next = min(int(due.sum()), self.pose_count - 1)

    def say_progress(self) -> None:
        """Say how many poses were sent, also when the first was, and how far that is."""
        self.health.values = {
            "played": str(self._next),
            "begun": f"{1e-9 * self.head.begun(self.now):.9f}",
            "position": f"{1e-9 * self.position:.3f}",
            "duration": f"{1e-9 * self._ages[-1]:.3f}",
        }

    def use(self) -> None:
        """Go on at the rate and with the timer that was set; lockstep has neither."""
        if self.settings.lockstep:
            return
        if self.has_begun and self.settings.rate != self.head.rate:
            self.destroy_timer(self._ticking)
            self._ticking = self._timer_at_its_pace()
        super().use()

    def go_to(self, position: int, at: int | None = None) -> None:
        """Play on there, and send at once the pose that is held there while it is paused."""
        self.head.go_to(position, self.now if at is None else at)
        self._next = min(int(np.searchsorted(self._ages, position)), self.pose_count - 1)
        if at is None:
            self._send(self._next)

    def _tick(self) -> None:
        """Send each pose whose time has come, to the nearest half period."""
        if self.health.state == "finished":
            if self.loops:
                self.restart()
            else:
                self._hold(self._sent)
            return
        if self.settings.paused:
            self._hold(self._next)
            return
        while not self._is_over() and self._is_due():
            self._send(self._next)
            self._next += 1
        self.say_progress()
        if self._is_over():
            self._begin_again_or_end()

    def _hold(self, pose: int) -> None:
        """Say a few times a second that a probe which is held still is still there.

        Nothing ages while the player holds the clock, too.
        """
        if pose < 0 or self.settings.clock:
            return
        if time.monotonic() - self._sent_at > 1.0 / HELD:
            self._send(pose)

    def _is_over(self) -> bool:
        return self._next >= self.pose_count

    def _is_due(self) -> bool:
        half = 0.5 * self._period * self.settings.rate
        return bool(self._ages[self._next] <= self.head.position(self.now) + half)

    def _on_image(self, image: Image) -> None:
        stamp = nanoseconds_of(image.header.stamp)
        if self.health.state != "playing" or stamp != self._stamps[self._next]:
            return
        self._next += 1
        self.say_progress()
        if self._is_over():
            self._begin_again_or_end()
        if self.health.state == "playing":
            self._send(self._next)

    def _send(self, i: int) -> None:
        self._sent, self._sent_at = i, time.monotonic()
        if self.settings.lockstep:
            self.head.go_to(int(self._ages[i]), self.now)
        stamp = self.tell_time()
        if self.settings.lockstep:
            stamp = stamp_message(int(self._stamps[i]))
        self._poses.publish(pose_message(self._path.pose(i), stamp, self._path.frame_id))
        self.health.published("tracker/pose")

    def _begin_again_or_end(self) -> None:
        if self.loops:
            self.restart(gap=int(self._period))
        else:
            self.end()

    def end(self) -> None:
        """Hold the last pose, or be done."""
        self.finish()
        self.get_logger().info("the path is at its end")
        if not self.settings.stay:
            self.finished.set_result(None)


def _rising_stamps(path: ProbePath) -> NDArray[np.int64]:
    """Stamps that tell the poses apart: their own, or else the times they were recorded at.

    Raises:
        BagError: neither rise from pose to pose.
    """
    for stamps in (path.stamps, path.log_times):
        if (np.diff(stamps) > 0).all():  # 0 and less would be no time
            return stamps if stamps[0] > 0 else stamps - stamps[0] + 10**9
    raise BagError(
        f"{path.topic}: neither stamps nor log times rise from pose to pose, so lockstep cannot "
        f"tell the poses apart; record the path again"
    )


main = partial(run_node, PathPlayer)


if __name__ == "__main__":
    sys.exit(main())
