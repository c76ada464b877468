"""Playing of recordings: rate, pause, place and end, as parameters say."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

from builtin_interfaces.msg import Time as TimeMessage
from rclpy.clock import Clock
from rclpy.parameter import Parameter
from rclpy.task import Future
from rosgraph_msgs.msg import Clock as ClockMessage

from us_sim.errors import BagError
from us_sim.nodes.guarded_node import GuardedNode, Health
from us_sim.nodes.messages import stamp_message
from us_sim.nodes.parameters import LiveSettings
from us_sim.nodes.settings import PlayerSettings
from us_sim.recording.playhead import Playhead
from us_sim.share import find_bag


class RecordingPlayer(GuardedNode):
    """A player that obeys its parameters and its service ``~/stop``.

    If its parameter ``clock`` is set it publishes ``/clock``, and goes by the computer's clock
    itself; else it goes by its node's, also when that is set back.
    """

    def __init__(self, name: str, settings: PlayerSettings, **kwargs: Any) -> None:
        super().__init__(name, **kwargs)
        self._live = LiveSettings(self, {"player": settings}, use=lambda _: self.apply_settings())
        chosen = self.settings
        if not chosen.path:
            raise BagError(f"{name}'s parameter `path` is missing; name a bag to play")
        self.path = find_bag(chosen.path)
        self.finished = Future()
        self.health = Health(self, str(self.path))
        self.head = Playhead(chosen.rate)
        self.first = self.length = 0  # ns: begin of the recording since 1970, and its duration
        self.gap = 0  # ns, from its end to its start where it loops
        self.damage: list[str] = []  # found so far
        self.has_begun = self._is_stopped = False
        self._latest = 0  # ns, of `now`
        self.clock = Clock() if chosen.clock else self.get_clock()
        if chosen.clock:
            self._clock_messages = self.create_stream_publisher(ClockMessage, "/clock")
            self.create_timer(1.0 / chosen.clock, self.publish_time)
        self.add_post_set_parameters_callback(self._seek)
        self.create_command("stop", self._stop)

    @property
    def settings(self) -> Any:
        """Present parameters, of the class of those by default."""
        return self._live.values["player"]

    @abstractmethod
    def go_to(self, position: int, at: int | None = None) -> None:
        """Play on from a position (ns) of the recording at a time of `now`.

        Without a time it plays on at once, and shows what is there even if it is paused.
        """

    @abstractmethod
    def send_due(self) -> bool:
        """Send what is due; return whether it is at its end."""

    def hold_still(self) -> None:
        """Do what is necessary while nothing moves."""

    def describe_progress(self) -> dict[str, str]:
        """Return position and duration, for diagnostics."""
        position, duration = 1e-9 * self.position, 1e-9 * self.length
        return {"position": f"{position:.3f}", "duration": f"{duration:.3f}"}

    @property
    def now(self) -> int:
        """Time of the player's clock, ns; 0 before simulated time has begun."""
        now = int(self.clock.now().nanoseconds)
        if now < self._latest:
            self.head.go_to(self.head.compute_position(self._latest), now)
        self._latest = now
        return now

    @property
    def position(self) -> int:
        """Position in the recording, ns from its start."""
        return min(max(self.head.compute_position(self.now), 0), self.length)

    def publish_time(self) -> TimeMessage:
        """Return the present time; with ``clock``, publish and return that of the recording."""
        if not self.settings.clock:
            return self.get_clock().now().to_msg()
        stamp = stamp_message(self.first + self.position)
        if self.has_begun:
            self._clock_messages.publish(ClockMessage(clock=stamp))
        return stamp

    def begin_playing(self) -> None:
        """Obey the parameters from now on."""
        self.has_begun = True
        self.apply_settings()

    def apply_settings(self) -> None:
        """Go on at the rate that was set, or hold still; do nothing before it began."""
        if not self.has_begun:
            return
        self.head.set_rate(self.settings.rate, self.now)
        self.head.set_held(self.settings.paused, self.now)
        if self.health.state != "finished" or self._loops:
            self._play()
        self._report()

    def play_on(self) -> None:
        """Send what is due, and at the end begin anew or end; a timer calls it."""
        if self.health.state == "finished" and not self._loops:
            self.hold_still()
            return
        is_over = self.health.state == "finished" or self.send_due()
        self.health.values = self.describe_progress()
        if is_over:
            self.begin_again_or_end()

    def begin_again_or_end(self) -> None:
        """Play again from the start if it loops, else end."""
        if self._loops:
            self._play()
            self.go_to(0, self.now + self.gap)
        else:
            self._end()

    @property
    def _loops(self) -> bool:
        return bool(self.settings.loop) and not self._is_stopped

    def _end(self) -> None:
        self.health.state = "finished"
        self._report()
        if self.settings.stay:
            return
        if self.damage:
            text = f"not all of the recording was played: {self.damage[0]}"
            self.finished.set_exception(BagError(text))
        else:
            self.finished.set_result(None)

    def _play(self) -> None:
        self.health.state = "paused" if self.settings.paused else "playing"

    def _stop(self) -> str:
        if not self.has_begun or self.health.state == "finished":
            return "nothing is played"
        self._is_stopped = True
        self._end()
        return ""

    def _seek(self, parameters: list[Parameter]) -> None:
        """Play on from a time whenever it is set, even to the same value."""
        times = [round(1e9 * each.value) for each in parameters if each.name == "time"]
        if not self.has_begun or not times:
            return
        self._is_stopped = False
        self.go_to(times[-1])
        self._play()
        self._report()

    def _report(self) -> None:
        self.health.values = self.describe_progress()
        self.health.publish_report()
