"""A player of recorded probe paths, in place of a tracker."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from numpy.typing import NDArray
from sensor_msgs.msg import Image

from us_sim.errors import BagError
from us_sim.nodes.messages import pose_message, stamp_message
from us_sim.nodes.process import MEASURING, node_main
from us_sim.nodes.qos import EVERY, SENT
from us_sim.nodes.sessions.playback import RecordingPlayer
from us_sim.nodes.settings import RECORDER, PathPlayerSettings
from us_sim.recording.decoding import nanoseconds_of
from us_sim.recording.path import ProbePath, read_path
from us_sim.settings.spelling import format_count

HELD = 5.0
"""Poses a second of a probe that is held still; images are called stale after half a second."""
CHECK_S, CHECKS = 0.05, 6
"""Period of looks for the awaited topics, and looks in a row that must find all of them: a
best-effort subscriber may find a publisher a little later than it is found itself."""
TELL_AFTER_S = 5.0  # after which the awaited topic is logged


class PathPlayer(RecordingPlayer):
    """A bag's poses on ``tracker/pose``, once the topics that its parameters name are there.

    Its parameters are those of `PathPlayerSettings`. What it waits for is logged after a while, and
    ``awaited`` in diagnostics.
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
        steps = np.diff(self._ages)
        self._step = float(np.median(steps)) if len(steps) else 0.01e9  # ns, from pose to pose
        self.first, self.length = int(self._path.log_times[0]), int(self._ages[-1])
        self._next = 0  # pose to be sent
        self._sent_at = 0.0  # s, of the monotonic clock
        self._poses = self.create_stream_publisher(
            PoseStamped, "tracker/pose", EVERY if lockstep else SENT
        )
        if lockstep:
            self.subscribe(Image, "ultrasound/image", self._on_image, EVERY)
        self._checks, self._waiting_since = 0, time.monotonic()
        self.health.state = "waiting"
        # Now, so that its thread goes first, too.
        self._ticking = self.create_timer(self._tick_s, self.play_on, clock=self.clock)
        self._ticking.cancel()
        self._starting = self.create_timer(CHECK_S, self._begin)
        self.pose_count = len(self._path)
        self.get_logger().info(
            f"{format_count(self.pose_count, 'pose')} of {self._path.topic} in {self.path}"
        )
        if self._path.note:
            self.get_logger().warning(self._path.note)

    @property
    def _tick_s(self) -> float:
        """Time from pose to pose as they are played, s, or less, since a held one is repeated."""
        return float(min(max(1e-9 * self._step / self.settings.rate, 1e-4), 1.0 / HELD))

    def _begin(self) -> None:
        """Begin once everything awaited has been there for a while."""
        missing = self._missing_topics()
        self._checks = 0 if missing else self._checks + 1
        logged = self.health.values.get("awaited", "")
        if missing not in ("", logged) and time.monotonic() - self._waiting_since > TELL_AFTER_S:
            self.health.values["awaited"] = missing
            self.get_logger().warning(f"nothing is played yet: waiting for {missing}")
        if self._checks < CHECKS or not self.now:
            return
        self._starting.cancel()
        self.health.state = "playing"
        now, begun = self.now, round(1e9 * self.settings.begun)
        if self.settings.lockstep:
            self.has_begun = True
            self.head.set_held(True, now)
            self.go_to(round(1e9 * self.settings.time))
            return
        self.go_to(round(1e9 * self.settings.time), begun if 0 < begun < now else now)
        turn = int(self._ages[-1] + self._step)
        if self.settings.loop and 0 < turn < self.head.compute_position(now):  # round and round
            self.head.go_to(self.head.compute_position(now) % turn, now)
        due = self._ages <= self.head.compute_position(now) - 0.5 * self._step
        self._next = min(int(due.sum()), self.pose_count - 1)
        self.get_logger().info(f"playing from pose {self._next}")
        self._ticking.reset()
        self.begin_playing()
        self.play_on()

    def _missing_topics(self) -> str:
        """Return the first that is awaited and not there; nothing when all are."""
        if not self._poses.get_subscription_count():
            return f"somebody to subscribe to {self._poses.topic_name}"
        for topic in map(self.resolve_topic_name, self.settings.await_topics):
            if not self.count_publishers(topic):
                return f"{topic} to be published"
        for topic in map(self.resolve_topic_name, self.settings.await_recorded):
            listeners = self.get_subscriptions_info_by_topic(topic)
            if RECORDER not in {info.node_name for info in listeners}:
                return f"{RECORDER} to subscribe to {topic}"
        return ""

    def describe_progress(self) -> dict[str, str]:
        """Return, for diagnostics, the poses that were sent and the time of the first, too."""
        return super().describe_progress() | {
            "played": str(self._next),
            "begun": f"{1e-9 * self.head.compute_start(self.now):.9f}",
        }

    def apply_settings(self) -> None:
        """Go on at the rate that was set; lockstep has none."""
        if self.settings.lockstep:
            return
        if self.has_begun and self.settings.rate != self.head.rate:
            self._ticking.timer_period_ns = round(1e9 * self._tick_s)
            self._ticking.reset()
        self.gap = round(self._step / self.settings.rate)
        super().apply_settings()

    def go_to(self, position: int, at: int | None = None) -> None:
        """Play on from a position; without a time ``at``, send the pose there at once."""
        self.head.go_to(position, self.now if at is None else at)
        self._next = min(int(np.searchsorted(self._ages, position)), self.pose_count - 1)
        if at is None:
            self._send(self._next)

    def send_due(self) -> bool:
        """Send each pose whose time has come, to the nearest half period."""
        if self.settings.paused:
            self.hold_still()
            return False
        due = self.head.compute_position(self.now) + 0.5 * self._step
        while not self._is_over and self._ages[self._next] <= due:
            self._send(self._next)
            self._next += 1
        if self.settings.rate < 1.0 and self._next and not self._is_over:
            self._hold(self._next - 1)
        return self._is_over

    def hold_still(self) -> None:
        """Send the pose of a held probe a few times a second, unless the player has the clock."""
        self._hold(min(self._next, self.pose_count - 1))

    def _hold(self, i: int) -> None:
        # 0.9: a tick may be early.
        if not self.settings.clock and time.monotonic() - self._sent_at > 0.9 / HELD:
            self._send(i)

    @property
    def _is_over(self) -> bool:
        return self._next >= self.pose_count

    def _on_image(self, image: Image) -> None:
        stamp = nanoseconds_of(image.header.stamp)
        if self.health.state != "playing" or stamp != self._stamps[self._next]:
            return
        self._next += 1
        self.health.values = self.describe_progress()
        if self._is_over:
            self.begin_again_or_end()
        if self.health.state == "playing":
            self._send(self._next)

    def _send(self, i: int) -> None:
        self._sent_at = time.monotonic()
        if self.settings.lockstep:
            self.head.go_to(int(self._ages[i]), self.now)
        stamp = self.publish_time()
        if self.settings.lockstep:
            stamp = stamp_message(int(self._stamps[i]))
        self._poses.publish(pose_message(self._path.pose_at(i), stamp, self._path.frame_id))
        self.health.count_published("tracker/pose")


def _rising_stamps(path: ProbePath) -> NDArray[np.int64]:
    """Return stamps that differ from pose to pose: their own, or else the times of recording."""
    for stamps in (path.stamps, path.log_times):
        if (np.diff(stamps) > 0).all():  # 0 and less would be no time
            return stamps if stamps[0] > 0 else stamps - stamps[0] + 10**9
    raise BagError(
        f"{path.topic}: neither stamps nor log times rise from pose to pose, so lockstep cannot "
        f"tell the poses apart; record the path again"
    )


main = node_main(PathPlayer, __name__)
