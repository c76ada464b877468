"""How something gets from where it is to where it is wanted: at once, smoothly, not too fast.

A lead goes straight to the goal: as fast as it may, and within the last ``speed * time_constant``
ever slower, by exp(-t / time_constant). What follows the lead lags by the same time constant. So
near the goal it is the critically damped system of second order, which is the fastest linear one
that does not overshoot; from afar it goes with the largest speed. Both phases are solved exactly,
so the path does not depend on the steps in which time passes.

A movement of minimum jerk (Flash and Hogan 1985) is closer to what an arm does by itself, yet it
begins with the cube of time: planned anew whenever the mouse moves it would hardly begin at all.

>>> import numpy as np
>>> from us_sim.tracking.virtual_hand.approach import Approach
>>> approach = Approach(np.zeros(1), speed=0.25, time_constant=0.02)
>>> approach.goal = np.array([0.05])
>>> [round(1e3 * float(approach.advance(0.05)[0]), 2) for _ in range(6)]  # mm
[7.91, 20.03, 32.5, 44.48, 49.17, 49.9]
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray


class Approach:
    """One quantity of a movement, of any number of coordinates.

    Its speed is never above ``speed``, its acceleration never above
    ``2 * speed / time_constant``, and half of that from rest. It stays within the triangle of
    where it is, where its lead is and the goal: from rest, on the straight line to the goal.

    Args:
        place: (K,) where it rests.
        speed: the largest, in the unit of the place per s.
        time_constant: s.
    """

    def __init__(self, place: NDArray[np.float64], speed: float, time_constant: float) -> None:
        self._speed, self._time_constant = speed, time_constant
        self.rest_at(place)

    def rest_at(self, place: NDArray[np.float64]) -> None:
        """Be somewhere, without movement."""
        self.place = np.array(place, dtype=np.float64)
        self._lead = self.place.copy()
        self.goal: NDArray[np.float64] = self.place.copy()

    def distance(self) -> float:
        """How far it, or its lead, still is from the goal."""
        return max(_norm(self.goal - self._lead), _norm(self.goal - self.place))

    def advance(self, seconds: float) -> NDArray[np.float64]:
        """(K,) the place, so many seconds later."""
        way = self.goal - self._lead
        distance, tau = _norm(way), self._time_constant
        fast = max(distance / self._speed - tau, 0.0)  # s until the lead slows down
        if fast > 0.0:
            passed = min(seconds, fast)
            velocity = way * (self._speed / distance)
            lag = self.place - self._lead + tau * velocity
            self._lead = self._lead + passed * velocity
            self.place = self._lead - tau * velocity + math.exp(-passed / tau) * lag
            seconds -= passed
        if seconds > 0.0:
            way, decay = self.goal - self._lead, math.exp(-seconds / tau)
            self.place = self.goal + decay * (self.place - self.goal - (seconds / tau) * way)
            self._lead = self.goal - decay * way
        return self.place


def _norm(vector: NDArray[np.float64]) -> float:
    return math.sqrt(float(vector @ vector))
