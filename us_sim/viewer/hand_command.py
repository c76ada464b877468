"""Commands of the pages to the hand that moves the probe, and the poses that obey them.

>>> from us_sim.tracking.virtual_hand import RestSurface, Stance
>>> from us_sim.viewer.hand_command import AskedPoses, HandCommand
>>> asked = HandCommand.read({"source": "a", "sequence": 7, "to": {"press": 0.004}})
>>> asked = asked.stance(Stance(rotation=0.1), RestSurface.plane(0.1))
>>> asked.press, asked.rotation
(0.004, 0.1)
>>> poses = AskedPoses()
>>> poses.ask("a page", 7)
>>> poses.published(stamp=2)
>>> poses.by(1), poses.by(2), poses.holder, poses.is_moving
(None, ('a page', 7), 'a page', True)
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, TypeGuard

import numpy as np

from us_sim.errors import MessageError
from us_sim.settings.spelling import shown
from us_sim.tracking.virtual_hand import DEEPEST, HIGHEST, STEEPEST, RestSurface, Stance

HOME_PRESS = 1e-3
"""m: where the probe begins it touches, so that there is an image."""
LIFTED = -0.01
"""m."""

_FARTHEST, _FULL = 10.0, 2.0 * math.pi
_TO = {"point": 3, "x": 1, "y": 1, "press": 1, "rotation": 1, "fan": 1, "rock": 1}
_BY = {"slide": 2, "press": 1, "rotation": 1, "fan": 1, "rock": 1}
_ANGLES = ("rotation", "fan", "rock")
_SINGLE = ("press", *_ANGLES)
_PLACES = ("home", "lift", "upright")
_LONGEST_SOURCE, _LAST = 40, 2**53


@dataclass(frozen=True)
class HandCommand:
    """One wish, as absolute values, changes, or a place that has a name."""

    source: str  # of which page
    sequence: int  # the page's number of the wish
    to: Mapping[str, tuple[float, ...]] = field(default_factory=dict)  # m and rad, by _TO
    by: Mapping[str, tuple[float, ...]] = field(default_factory=dict)  # m and rad, by _BY
    go: str | None = None  # home: begin anew; lift: off the skin; upright: no angles

    @classmethod
    def read(cls, value: Any) -> HandCommand:
        """The wish in what a page sent, decoded from JSON.

        Raises:
            MessageError: it is none, with what is wrong.
        """
        if not isinstance(value, dict):
            raise MessageError(f"a command to the hand is an object, not {shown(value)}")
        unknown = value.keys() - {"source", "sequence", "to", "by", "go"}
        if unknown:
            raise MessageError(f"a command to the hand has no {shown(min(unknown))}")
        source, sequence, go = value.get("source"), value.get("sequence"), value.get("go")
        if not is_source(source):
            raise MessageError(
                f"the hand's source is a text of 1 to {_LONGEST_SOURCE} characters, not "
                f"{shown(source)}"
            )
        if type(sequence) is not int or not 0 <= sequence <= _LAST:
            raise MessageError(f"the hand's sequence is a count, not {shown(sequence)}")
        if go is not None and go not in _PLACES:
            raise MessageError(f"the hand goes to {', '.join(_PLACES)}, not to {shown(go)}")
        to, by = _numbers(value, "to", _TO), _numbers(value, "by", _BY)
        return cls(source, sequence, to, by, go)

    def stance(self, goal: Stance, surface: RestSurface) -> Stance:
        """The stance that is wanted now, within what a hand can do.

        Args:
            goal: what was wanted before.
            surface: that the probe stands on.
        """
        if self.go == "home":
            goal = Stance.home(surface, HOME_PRESS)
        elif self.go == "lift":
            goal = replace(goal, press=LIFTED)
        elif self.go == "upright":
            goal = replace(goal, rotation=0.0, fan=0.0, rock=0.0)
        goal = _with(goal, {name: n[0] for name, n in self.to.items() if name in _SINGLE})
        if "point" in self.to:
            goal = replace(goal, point=surface.closest(np.array(self.to["point"])).point)
        if "x" in self.to or "y" in self.to:
            x, y = (self.to.get(name, (goal.point[axis],))[0] for axis, name in enumerate("xy"))
            goal = replace(goal, point=surface.above(x, y).point)
        if "slide" in self.by:
            goal = goal.slid(surface, *self.by["slide"])
        changed = {n: getattr(goal, n) + self.by[n][0] for n in _SINGLE if n in self.by}
        return _with(goal, changed).within_reach()


def is_source(value: Any) -> TypeGuard[str]:
    """Whether it can be the name that a page has given itself."""
    return isinstance(value, str) and 0 < len(value) <= _LONGEST_SOURCE


def _with(stance: Stance, numbers: dict[str, Any]) -> Stance:
    return replace(stance, **numbers)


def _numbers(
    value: dict[str, Any], key: str, sizes: dict[str, int]
) -> dict[str, tuple[float, ...]]:
    """The numbers of one part of a command, each as many as there must be."""
    given = value.get(key, {})
    if not isinstance(given, dict):
        raise MessageError(f"the hand's {key} is an object, not {shown(given)}")
    numbers = {}
    for name, listed in given.items():
        if name not in sizes:
            raise MessageError(f"the hand cannot move {shown(name)}: {', '.join(sizes)}")
        values = listed if isinstance(listed, list) else [listed]
        proper = all(type(n) in (int, float) and abs(n) <= sys.float_info.max for n in values)
        if not proper or len(values) != sizes[name]:
            raise MessageError(
                f"the hand's {name} is {sizes[name]} finite number{'s' * (sizes[name] > 1)}, not "
                f"{shown(listed)}"
            )
        limit = _FULL if name in _ANGLES else _FARTHEST
        if max(map(abs, values)) > limit:
            far, end = max(values, key=abs), limit
            if name in _ANGLES:
                far, end = math.degrees(far), math.degrees(end)
            unit = "°" if name in _ANGLES else " m"
            raise MessageError(
                f"the hand's {name} is -{end:.4g} to {end:.4g}{unit}, not {far:.4g}{unit}"
            )
        numbers[name] = tuple(map(float, values))
    return numbers


def hand_state(
    surface: RestSurface | None, stance: Stance | None, goal: Stance | None
) -> dict[str, Any]:
    """Where the probe is and goes, and where it may be, as far as that is known.

    Args:
        surface: on which it stands.
        stance: how it is held.
        goal: how it will be.

    Returns:
        m and rad, frame ``patient``.
    """
    state: dict[str, Any] = {}
    if stance is not None and goal is not None:
        state |= {"stance": _stance_numbers(stance), "goal": _stance_numbers(goal)}
    if surface is not None:
        lower, upper = surface.lower.tolist(), surface.upper.tolist()
        state["range"] = {
            "x": [lower[0], upper[0]],
            "y": [lower[1], upper[1]],
            "press": [-HIGHEST, DEEPEST],
            "tilt": [-STEEPEST, STEEPEST],
        }
    return state


def _stance_numbers(stance: Stance) -> dict[str, float]:
    x, y, z = stance.point.tolist()
    return {
        "x": x,
        "y": y,
        "z": z,
        "press": stance.press,
        "rotation": stance.rotation,
        "fan": stance.fan,
        "rock": stance.rock,
    }


_KEPT = 512  # poses
_MOVES_S = 2.0  # after its last wish a page holds the probe, and moves it no more


class AskedPoses:
    """The commands of pages, and the poses that obey them.

    It is written in one thread, and may be read in others.
    """

    def __init__(self) -> None:
        self.at = 0.0
        """When the last wish came, s of the monotonic clock."""
        self.holder = ""
        """The page that acted last; nothing if none has, or once it has gone."""
        self._connection = 0
        self._last: tuple[str, int] | None = None
        self._by_stamp: dict[int, tuple[str, int]] = {}

    @property
    def is_moving(self) -> bool:
        """Whether the page that holds the probe has moved it a moment ago."""
        return bool(self.holder) and time.monotonic() - self.at < _MOVES_S

    def ask(self, source: str, sequence: int, connection: int = 0) -> None:
        """A page (``source``), on a connection, has a wish, by the page's own number."""
        self._last = (source, sequence)
        self.at = time.monotonic()
        self.hold(source, connection)

    def hold(self, source: str, connection: int = 0) -> None:
        """A page holds the probe from here on, until another acts or its connection ends."""
        self.holder, self._connection = source, connection

    def left(self, connection: int) -> None:
        """A connection has ended."""
        if connection == self._connection:
            self.holder = ""

    def published(self, stamp: int) -> None:
        """The pose of a stamp (ns) contains all that has been asked until now."""
        if self._last is None:
            return
        self._by_stamp[stamp] = self._last
        if len(self._by_stamp) > _KEPT:
            del self._by_stamp[next(iter(self._by_stamp))]

    def by(self, stamp: int) -> tuple[str, int] | None:
        """The page, and the number of its last wish, that the pose of a stamp (ns) contains."""
        return self._by_stamp.get(stamp)
