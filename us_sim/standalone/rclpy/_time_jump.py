"""Jumps of a clock that can be set, and who wants to know of them."""

from collections.abc import Callable
from enum import IntEnum
from types import TracebackType
from typing import TYPE_CHECKING

from .duration import Duration

if TYPE_CHECKING:
    from .clock import Clock

__all__ = ["ClockChange", "JumpHandle", "JumpThreshold", "TimeJump"]


class ClockChange(IntEnum):
    """Whether a jump also switched between simulated and real time."""

    ROS_TIME_NO_CHANGE = 1
    ROS_TIME_ACTIVATED = 2
    ROS_TIME_DEACTIVATED = 3
    SYSTEM_TIME_NO_CHANGE = 4


class JumpThreshold:
    """How far a clock has to jump for somebody to be told."""

    def __init__(
        self,
        *,
        min_forward: Duration | None,
        min_backward: Duration | None,
        on_clock_change: bool = True,
    ):
        if min_forward is not None and min_forward.nanoseconds <= 0:
            raise ValueError("min_forward must be a positive non-zero duration")
        if min_backward is not None and min_backward.nanoseconds >= 0:
            raise ValueError("min_backward must be a negative non-zero duration")
        if min_forward is None and min_backward is None and not on_clock_change:
            raise ValueError("At least one jump threshold must be enabled")
        self.min_forward = min_forward
        self.min_backward = min_backward
        self.on_clock_change = on_clock_change


class TimeJump:
    """One jump: what changed and by how much."""

    def __init__(self, clock_change: ClockChange, delta: Duration):
        if not isinstance(clock_change, ClockChange):
            raise TypeError("clock_change must be an instance of rclpy.clock.ClockChange")
        self._clock_change = clock_change
        self._delta = delta

    @property
    def clock_change(self) -> ClockChange:
        return self._clock_change

    @property
    def delta(self) -> Duration:
        return self._delta


class JumpHandle:
    """Callbacks for the jumps of a clock, until `unregister` or the end of a with block."""

    def __init__(
        self,
        *,
        clock: "Clock",
        threshold: JumpThreshold,
        pre_callback: Callable[[], None] | None,
        post_callback: Callable[[TimeJump], None] | None,
    ) -> None:
        if pre_callback is None and post_callback is None:
            raise ValueError("One of pre_callback or post_callback must be callable")
        if pre_callback is not None and not callable(pre_callback):
            raise ValueError("pre_callback must be callable if given")
        if post_callback is not None and not callable(post_callback):
            raise ValueError("post_callback must be callable if given")
        self._clock: Clock | None = clock
        self._threshold = threshold
        self._pre_callback = pre_callback
        self._post_callback = post_callback
        clock._jump_handles.append(self)

    def is_concerned_by(self, jump: TimeJump) -> bool:
        """Whether a jump is beyond the threshold."""
        threshold = self._threshold
        if jump.clock_change in (
            ClockChange.ROS_TIME_ACTIVATED,
            ClockChange.ROS_TIME_DEACTIVATED,
        ):
            return threshold.on_clock_change
        forward, backward = threshold.min_forward, threshold.min_backward
        return (forward is not None and jump.delta >= forward) or (
            backward is not None and jump.delta <= backward
        )

    def before(self) -> None:
        """Call what was given for the moment before a jump."""
        if self._pre_callback is not None:
            self._pre_callback()

    def after(self, jump: TimeJump) -> None:
        """Call what was given for the moment after a jump."""
        if self._post_callback is not None:
            self._post_callback(jump)

    def unregister(self) -> None:
        """Be told of no further jumps."""
        clock, self._clock = self._clock, None
        if clock is not None:
            clock._jump_handles.remove(self)

    def __enter__(self) -> "JumpHandle":
        return self

    def __exit__(
        self,
        t: type[BaseException] | None,
        v: BaseException | None,
        tb: TracebackType | None,
    ) -> None:
        self.unregister()
