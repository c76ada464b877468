"""The hand's movement from one stance to the next: a jump of the mouse does not stab the tissue.

>>> from us_sim.tracking.virtual_hand.motion import Motion
>>> from us_sim.tracking.virtual_hand.stance import Stance
>>> motion = Motion(Stance())
>>> motion.aim(Stance(press=0.01))
>>> pressed = [round(1e3 * motion.advance(0.04).press, 2) for _ in range(4)]  # mm
>>> pressed, motion.is_at_rest
([3.41, 7.98, 9.57, 9.92], False)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from us_sim.tracking.virtual_hand.approach import Approach
from us_sim.tracking.virtual_hand.stance import Stance, half_turn

_NEAR, _ALIGNED = 2e-6, 1e-4
"""m and rad from the goal: it is reached, for a pixel is some 80 µm."""


@dataclass(frozen=True)
class HandSpeed:
    """What a hand does at most: the quick end of what sonographers do, far below a thrust."""

    slide: float = 0.25  # m/s, of the line from the one point of the skin to the other
    press: float = 0.15  # m/s
    turn: float = math.pi  # rad/s, of rotation, fan and rock together, against the skin
    time_constant: float = 0.02  # s; following a slow mouse, the probe is twice that behind


class Motion:
    """Takes the probe to the stance that was asked for last.

    Sliding, pressing and turning each go at their own pace, see `Approach`. The way from one
    point of the skin to another is a straight line; the probe stands on the skin closest to it,
    so it goes over the skin of an arm and not through it.
    """

    def __init__(self, stance: Stance, speed: HandSpeed | None = None) -> None:
        speed = speed or HandSpeed()
        point, press, turn = _parts(stance)
        self._slide = Approach(point, speed.slide, speed.time_constant)
        self._press = Approach(press, speed.press, speed.time_constant)
        self._turn = Approach(turn, speed.turn, speed.time_constant)

    @property
    def stance(self) -> Stance:
        """Where it is now."""
        return _stance(self._slide.place, self._press.place, self._turn.place)

    @property
    def goal(self) -> Stance:
        """Where it goes."""
        return _stance(self._slide.goal, self._press.goal, self._turn.goal)

    @property
    def is_at_rest(self) -> bool:
        """Whether it is where it goes."""
        metres = max(self._slide.distance(), self._press.distance())
        return metres < _NEAR and self._turn.distance() < _ALIGNED

    def rest_at(self, stance: Stance) -> None:
        """Be there, without any movement, as when the probe is taken from somebody else."""
        for approach, part in zip(self._approaches, _parts(stance), strict=True):
            approach.rest_at(part)

    def aim(self, stance: Stance) -> None:
        """Go there from now on, turning the shorter way."""
        self._slide.goal, self._press.goal, turn = _parts(stance)
        turn[0] = self._turn.place[0] + half_turn(turn[0] - self._turn.place[0])
        self._turn.goal = turn

    def advance(self, seconds: float) -> Stance:
        """The stance so many seconds later."""
        for approach in self._approaches:
            approach.advance(seconds)
        return self.stance

    @property
    def _approaches(self) -> tuple[Approach, Approach, Approach]:
        return self._slide, self._press, self._turn


def _parts(stance: Stance) -> tuple[NDArray[np.float64], ...]:
    """The point (3,) m, the press (1,) m and the turn (3,) rad."""
    turn = np.array([stance.rotation, stance.fan, stance.rock])
    return stance.point.copy(), np.array([stance.press]), turn


def _stance(
    point: NDArray[np.float64], press: NDArray[np.float64], turn: NDArray[np.float64]
) -> Stance:
    rotation, fan, rock = turn.tolist()
    return Stance(point, float(press[0]), half_turn(rotation), fan, rock)
