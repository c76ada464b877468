"""The state of tracking, by the time since the probe's last pose.

>>> from us_sim.tracking.state import TrackingClock
>>> clock = TrackingClock(coast_for=0.3, lost_after=1.0)
>>> clock.state(0).value
'waiting'
>>> clock.seen(0)
>>> [clock.state(ms * 1_000_000).value for ms in (100, 500, 1500)]
['tracked', 'coasting', 'lost']
"""

from __future__ import annotations

from enum import Enum

from us_sim.errors import TrackingError


class TrackingState(Enum):
    """How far the probe's place is known."""

    WAITING = "waiting"  # no pose yet
    TRACKED = "tracked"
    COASTING = "coasting"  # poses are overdue: the probe is taken to be where it was
    LOST = "lost"  # it may be anywhere


class TrackingClock:
    """The state by the age of the last pose that was believed, on the clock of its arrival.

    Args:
        coast_for: s without a pose after which the state is no more *tracked* but *coasting*.
        lost_after: s without a pose after which it is *lost*; a pose makes it *tracked* again.

    Raises:
        TrackingError: the times are not 0 < coast_for <= lost_after.
    """

    def __init__(self, *, coast_for: float, lost_after: float) -> None:
        if not 0.0 < coast_for <= lost_after < float("inf"):
            raise TrackingError(
                f"a probe coasts after {coast_for:g} s without a pose and is lost after "
                f"{lost_after:g} s: the first must be positive and the second no less"
            )
        self._coasts = round(1e9 * coast_for)
        self._lost = round(1e9 * lost_after)
        self.reset()

    def reset(self) -> None:
        """Forget that there ever was a pose."""
        self._seen: int | None = None

    def seen(self, now_ns: int) -> None:
        """A pose came and was believed at this time."""
        self._seen = now_ns

    def state(self, now_ns: int) -> TrackingState:
        """The state at a time; where the clock was set back, the pose's age counts anew."""
        if self._seen is None:
            return TrackingState.WAITING
        self._seen = min(self._seen, now_ns)
        age = now_ns - self._seen
        if age < self._coasts:
            return TrackingState.TRACKED
        return TrackingState.COASTING if age < self._lost else TrackingState.LOST
