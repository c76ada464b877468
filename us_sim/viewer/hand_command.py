"""Commands of a page to the hand that holds the probe.

>>> import numpy as np
>>> from us_sim.tracking.virtual_hand import Stance, StandingSurface
>>> command = HandCommand.read({"source": "a", "sequence": 7, "to": {"press": 0.004}})
>>> surface = StandingSurface(np.eye(3), np.array([[0, 2, 1]]))
>>> stance = command.change_stance(Stance(rotation=0.1), surface)
>>> stance.press, stance.rotation
(0.004, 0.1)
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeGuard

import numpy as np

from us_sim.errors import MessageError
from us_sim.settings.spelling import short_repr
from us_sim.tracking.virtual_hand import Stance, StandingSurface

HOME_PRESS = 1e-3  # m; the probe touches at home, so that there is an image
LIFTED = -0.01  # m
ANGLES = ("rotation", "fan", "rock")
SINGLE = ("press", *ANGLES)
_PLACES = ("home", "lift", "upright")
_SIZES = {"to": {"point": 3, "x": 1, "y": 1}, "by": {"slide": 2}}
_SIZES = {key: sizes | dict.fromkeys(SINGLE, 1) for key, sizes in _SIZES.items()}
"""Count of numbers of each value (``to``) and each change (``by``)."""
_FARTHEST, _FULL = 10.0, 2.0 * math.pi  # m and rad
_LONGEST_SOURCE, _LAST = 40, 2**53


@dataclass(frozen=True)
class HandCommand:
    """One command, as absolute values, changes, or a named place."""

    source: str  # the page
    sequence: int  # the page's number of the command
    to: Mapping[str, tuple[float, ...]]  # m and rad, by name
    by: Mapping[str, tuple[float, ...]]  # m and rad, by name
    go: str | None = None  # home: begin anew; lift: off the skin; upright: no angles

    @classmethod
    def read(cls, value: Any) -> HandCommand:
        """Read a command from a page's message, decoded from JSON.

        Raises:
            MessageError: the message is no command.
        """
        known = {"source", "sequence", "to", "by", "go"}
        if not isinstance(value, dict) or not value.keys() <= known:
            raise MessageError(
                f"{short_repr(value)} is no command to the hand: load the page again"
            )
        source, sequence, go = value.get("source"), value.get("sequence"), value.get("go")
        if not is_source(source):
            raise MessageError(f"source: {short_repr(source)} names no page: load it again")
        if type(sequence) is not int or not 0 <= sequence <= _LAST:
            raise MessageError(f"sequence: {short_repr(sequence)} is no count: load the page again")
        if go not in (None, *_PLACES):
            raise MessageError(f"go: {short_repr(go)} is none of {', '.join(_PLACES)}")
        return cls(source, sequence, _read_numbers(value, "to"), _read_numbers(value, "by"), go)

    def change_stance(self, goal: Stance, surface: StandingSurface) -> Stance:
        """Return the new goal, within the hand's limits.

        Args:
            goal: the goal before the command.
            surface: the surface on which the probe stands.
        """
        if self.go == "home":
            goal = Stance.create_home(surface, HOME_PRESS)
        elif self.go == "lift":
            goal = replace(goal, press=LIFTED)
        elif self.go == "upright":
            goal = replace(goal, rotation=0.0, fan=0.0, rock=0.0)
        wanted: dict[str, Any] = {name: n[0] for name, n in self.to.items() if name in SINGLE}
        goal = replace(goal, **wanted)
        if "point" in self.to:
            goal = replace(goal, point=surface.find_closest(np.array(self.to["point"])).point)
        if "x" in self.to or "y" in self.to:
            x, y = (self.to.get(name, (goal.point[axis],))[0] for axis, name in enumerate("xy"))
            goal = replace(goal, point=surface.find_top(x, y).point)
        if "slide" in self.by:
            goal = goal.slide_along(surface, *self.by["slide"])
        changed = {n: getattr(goal, n) + self.by[n][0] for n in SINGLE if n in self.by}
        return replace(goal, **changed).clip_to_reach()


def is_source(value: Any) -> TypeGuard[str]:
    """Return whether a value can be a page's name for itself."""
    return isinstance(value, str) and 0 < len(value) <= _LONGEST_SOURCE


def _read_numbers(value: dict[str, Any], key: str) -> dict[str, tuple[float, ...]]:
    """Read the numbers of one part of a command, ``to`` or ``by``."""
    given, sizes = value.get(key, {}), _SIZES[key]
    if not isinstance(given, dict) or not given.keys() <= sizes.keys():
        raise MessageError(f"{key}: {short_repr(given)} is no object of {', '.join(sizes)}")
    numbers = {}
    for name, listed in given.items():
        values = listed if isinstance(listed, list) else [listed]
        limit, unit = (_FULL, "rad") if name in ANGLES else (_FARTHEST, "m")
        if len(values) != sizes[name] or not all(
            type(n) in (int, float) and abs(n) <= limit for n in values
        ):
            raise MessageError(
                f"{name}: {short_repr(listed)} is not {sizes[name]} within ±{limit:.3g} {unit}"
            )
        numbers[name] = tuple(map(float, values))
    return numbers
