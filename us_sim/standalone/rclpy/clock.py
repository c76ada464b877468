"""Clocks: system, steady, and ROS time, which a simulator can set.

>>> clock = Clock(clock_type=ClockType.ROS_TIME)
>>> clock.set_ros_time_override(Time(seconds=3, clock_type=ClockType.ROS_TIME))
>>> clock._set_ros_time_is_active(True)
>>> clock.now()
Time(nanoseconds=3000000000, clock_type=ROS_TIME)
"""

import time as wall
import weakref
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from ._time_jump import ClockChange, JumpHandle, JumpThreshold, TimeJump
from ._wake_up import WakeUp
from .clock_type import ClockType
from .constants import S_TO_NS
from .duration import Duration
from .exceptions import NotInitializedException
from .time import Time

if TYPE_CHECKING:
    from .context import Context
    from .timer import Timer

__all__ = [
    "Clock",
    "ClockChange",
    "ClockType",
    "JumpHandle",
    "JumpThreshold",
    "ROSClock",
    "TimeJump",
]


class Clock:
    """Tells the time of one kind; `Clock(clock_type=ClockType.ROS_TIME)` is a ROSClock."""

    _clock_type: ClockType
    _jump_handles: list[JumpHandle]
    _timers: "weakref.WeakSet[Timer]"

    def __new__(cls, *, clock_type: ClockType = ClockType.SYSTEM_TIME) -> "Clock":
        if not isinstance(clock_type, ClockType):
            raise TypeError("Clock type must be a ClockType enum")
        self: Clock
        if clock_type is ClockType.ROS_TIME:
            self = super().__new__(ROSClock)
            self._active = False  # type: ignore[attr-defined]
            self._override = 0  # type: ignore[attr-defined]
        else:
            self = super().__new__(cls)
        self._clock_type = clock_type
        self._jump_handles = []
        self._timers = weakref.WeakSet()
        return self

    @property
    def clock_type(self) -> ClockType:
        return self._clock_type

    def __repr__(self) -> str:
        return f"Clock(clock_type={self._clock_type.name})"

    def now(self) -> Time:
        """The time now."""
        return Time(nanoseconds=self._now(), clock_type=self._clock_type)

    def _now(self) -> int:
        if self._clock_type is ClockType.STEADY_TIME:
            return wall.monotonic_ns()
        return wall.time_ns()

    def _runs_by_itself(self) -> bool:
        """Whether this clock advances with real time, so that one can wait for it."""
        return True

    def create_jump_callback(
        self,
        threshold: JumpThreshold,
        *,
        pre_callback: Callable[[], None] | None = None,
        post_callback: Callable[[TimeJump], None] | None = None,
    ) -> JumpHandle:
        """Have functions called before and after this clock is set further than a threshold.

        Raises:
            ValueError: neither callback was given, or one is not callable.
        """
        return JumpHandle(
            clock=self,
            threshold=threshold,
            pre_callback=pre_callback,
            post_callback=post_callback,
        )

    def sleep_until(self, until: Time, context: "Context | None" = None) -> bool:
        """Sleep until this clock shows a time.

        Returns:
            True when the time came; False when the context was shut down before, or ROS time was
            switched between simulated and real.

        Raises:
            NotInitializedException: the context is not up.
            ValueError: the time is of another kind of clock.
        """
        if context is None:
            from .utilities import get_default_context

            context = get_default_context()
        handle = context.handle
        if handle is None or not handle.ok():
            raise NotInitializedException()
        if until.clock_type != self._clock_type:
            raise ValueError("until's clock type does not match this clock's type")
        waiting = WakeUp()
        handle.register(waiting)
        ran_by_itself = self._runs_by_itself()
        threshold = JumpThreshold(
            min_forward=Duration(nanoseconds=1),
            min_backward=Duration(nanoseconds=-1),
            on_clock_change=True,
        )
        with self.create_jump_callback(threshold, post_callback=lambda _: waiting.wake()):
            while handle.ok() and self._runs_by_itself() == ran_by_itself:
                remaining = until.nanoseconds - self._now()
                if remaining <= 0:
                    return True
                waiting.wait(remaining / S_TO_NS if ran_by_itself else None)
        return False

    def sleep_for(self, rel_time: Duration, context: "Context | None" = None) -> bool:
        """Sleep for a while by this clock; returns and raises as `sleep_until`."""
        return self.sleep_until(self.now() + rel_time, context)


class ROSClock(Clock):
    """A clock that shows system time until it is set by a simulator."""

    _active: bool
    _override: int

    def __new__(cls) -> "ROSClock":
        self = super().__new__(Clock, clock_type=ClockType.ROS_TIME)
        assert isinstance(self, ROSClock)
        return self

    @property
    def ros_time_is_active(self) -> bool:
        return self._active

    def set_ros_time_override(self, time: Time) -> None:
        """Set the time that this clock shows while ROS time is active."""
        if not isinstance(time, Time):
            raise TypeError(
                f"Time must be specified as rclpy.time.Time. Received type: {type(time)}"
            )
        if self._active:
            self._jump(
                ClockChange.ROS_TIME_NO_CHANGE,
                time.nanoseconds - self._override,
                override=time.nanoseconds,
            )
        else:
            self._override = time.nanoseconds

    def _set_ros_time_is_active(self, enabled: bool) -> None:
        if enabled == self._active:
            return
        difference = self._override - wall.time_ns()
        if enabled:
            self._jump(ClockChange.ROS_TIME_ACTIVATED, difference, active=True)
        else:
            self._jump(ClockChange.ROS_TIME_DEACTIVATED, -difference, active=False)

    def _jump(
        self,
        change: ClockChange,
        delta: int,
        *,
        active: bool | None = None,
        override: int | None = None,
    ) -> None:
        jump = TimeJump(change, Duration(nanoseconds=delta))
        concerned: list[Any] = [h for h in self._jump_handles if h.is_concerned_by(jump)]
        for jump_handle in concerned:
            jump_handle.before()
        before = self._now()
        if active is not None:
            self._active = active
        if override is not None:
            self._override = override
        for timer in list(self._timers):
            timer._on_time_jump(jump, before)
        for jump_handle in concerned:
            jump_handle.after(jump)

    def _now(self) -> int:
        return self._override if self._active else wall.time_ns()

    def _runs_by_itself(self) -> bool:
        return not self._active
