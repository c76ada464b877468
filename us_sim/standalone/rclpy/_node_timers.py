"""The timers, rates and guard conditions of a node."""

from collections.abc import Callable, Iterator
from typing import Any

from ._node_parts import NodeParts
from .callback_groups import CallbackGroup, ReentrantCallbackGroup
from .clock import Clock
from .constants import S_TO_NS
from .guard_condition import GuardCondition
from .timer import Rate, Timer

__all__ = ["NodeTimers"]


class NodeTimers(NodeParts):
    """Makes, lists and destroys timers, rates and guard conditions."""

    def __init__(self) -> None:
        super().__init__()
        self._timers: list[Timer] = []
        self._guards: list[GuardCondition] = []
        self._rate_group = ReentrantCallbackGroup()

    @property
    def timers(self) -> Iterator[Timer]:
        yield from self._timers

    @property
    def guards(self) -> Iterator[GuardCondition]:
        yield from self._guards

    def create_timer(
        self,
        timer_period_sec: float,
        callback: Callable[..., Any],
        callback_group: CallbackGroup | None = None,
        clock: Clock | None = None,
        autostart: bool = True,
    ) -> Timer:
        """Call back each period, by the node's clock unless another one is given."""
        return self._create_timer(timer_period_sec, callback, callback_group, clock, autostart)

    def _create_timer(
        self,
        timer_period_sec: float,
        callback: Callable[..., Any] | None,
        callback_group: CallbackGroup | None,
        clock: Clock | None,
        autostart: bool,
    ) -> Timer:
        group = callback_group or self._default_callback_group
        timer = Timer(
            callback,
            group,
            int(float(timer_period_sec) * S_TO_NS),
            clock or self._clock,
            context=self._context,
            autostart=autostart,
        )
        group.add_entity(timer)
        self._timers.append(timer)
        self._wake_executor()
        return timer

    def create_guard_condition(
        self, callback: Callable[..., Any], callback_group: CallbackGroup | None = None
    ) -> GuardCondition:
        """Call back when somebody triggers."""
        group = callback_group or self._default_callback_group
        guard = GuardCondition(callback, group, context=self._context)
        group.add_entity(guard)
        self._guards.append(guard)
        self._wake_executor()
        return guard

    def create_rate(self, frequency: float, clock: Clock | None = None) -> Rate:
        """Something to sleep by, so many times a second; raises ValueError unless positive."""
        if frequency <= 0:
            raise ValueError("frequency must be > 0")
        timer = self._create_timer(1.0 / frequency, None, self._rate_group, clock, True)
        return Rate(timer, context=self._context)

    def destroy_timer(self, timer: Timer) -> bool:
        """Stop a timer for good; False when it is none of this node's."""
        return self._destroy(timer, self._timers)

    def destroy_guard_condition(self, guard: GuardCondition) -> bool:
        """Stop listening to triggers; False when it is none of this node's."""
        return self._destroy(guard, self._guards)

    def destroy_rate(self, rate: Rate) -> bool:
        """Stop a rate for good; False when it is none of this node's."""
        found = self.destroy_timer(rate._timer)
        rate.destroy()
        return found
