"""Timers, whose callbacks executors call periodically."""

from collections.abc import Callable
from operator import attrgetter
from typing import Any

from ._rclpy_pybind11 import Destroyable, RCLError
from .callback_groups import CallbackGroup
from .clock import Clock
from .context import Context
from .utilities import get_default_context


class Timer(Destroyable):
    """Calls back each period. Periods that were missed are skipped, not caught up with."""

    _executor_event = False
    clock = property(attrgetter("_clock"))

    def __init__(
        self,
        callback: Callable[..., Any] | None,
        callback_group: CallbackGroup | None,
        timer_period_ns: int,
        clock: Clock,
        *,
        context: Context | None = None,
        autostart: bool = True,
    ):
        context = get_default_context() if context is None else context
        context._require_init("timer")
        if timer_period_ns < 0:
            raise RCLError("failed to create timer: timer period must be non-negative")
        self._context = context
        self._clock = clock
        self._period = int(timer_period_ns)
        self._last_call = clock._now()
        self._next_call = self._last_call + self._period
        self._canceled = not autostart
        self.callback = callback
        self.callback_group = callback_group
        clock._timers.add(self)

    @property
    def timer_period_ns(self) -> int:
        self._require_existence()
        return self._period

    @timer_period_ns.setter
    def timer_period_ns(self, value: int) -> None:
        self._require_existence()
        if int(value) < 0:
            raise RCLError("failed to exchange timer period: period must be non-negative")
        self._period = int(value)

    def is_ready(self) -> bool:
        """Whether the callback is due."""
        self._require_existence()
        return self._stirred()

    def is_canceled(self) -> bool:
        """Whether the timer is stopped."""
        self._require_existence()
        return self._canceled

    def cancel(self) -> None:
        """Stop the timer until `reset`."""
        self._require_existence()
        self._canceled = True

    def reset(self) -> None:
        """Start the timer, the next call being one period from now."""
        self._require_existence()
        self._next_call = self._clock._now() + self._period
        self._canceled = False
        self._context._wake_all()

    def time_since_last_call(self) -> int:
        """Nanoseconds since the callback was called, or since the timer was made."""
        self._require_existence()
        return self._clock._now() - self._last_call

    def time_until_next_call(self) -> int | None:
        """Nanoseconds until the callback is due, negative when it is late, None when stopped."""
        self._require_existence()
        return None if self._canceled else self._next_call - self._clock._now()

    def destroy(self) -> None:
        """Stop the timer for good."""
        super().destroy()
        self._canceled = True
        self._clock._timers.discard(self)

    def _stirred(self) -> bool:
        return not self._canceled and self._next_call <= self._clock._now()

    def _fetch(self) -> bool:
        return True

    def _real_time_left(self) -> int | None:
        """Nanoseconds of real time until it is due; None when real time does not bring that."""
        if self._canceled or not self._clock._runs_by_itself():
            return None
        return self._next_call - self._clock._now()

    def _take(self) -> Callable[..., Any] | None:
        if self._canceled:
            return None
        now = self._last_call = self._clock._now()
        if not self._period:
            self._next_call = max(self._next_call, now)
        else:  # the first period that is still to come
            periods = max(1, 1 + (now - self._next_call) // self._period)
            self._next_call += periods * self._period
        return self.callback

    def _on_time_jump(self, before: int, is_other_time: bool) -> None:
        """Keep the rest of the period when another kind of time begins; restart it when time
        goes back by more than a period."""
        now = self._clock._now()
        if is_other_time:
            self._last_call += now - before
            self._next_call += now - before
        elif now < self._last_call:
            self._last_call = now
            self._next_call = now + self._period
        self._context._wake_all()
