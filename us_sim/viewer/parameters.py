"""A parameter of a node as a page shows it: in the unit a person reads, with range and meaning.

>>> from us_sim.viewer.parameters import ParameterKind, Parameter
>>> depth = Parameter("slice_interpolator", "depth", ParameterKind.NUMBER, 0.04, "mm", size=1e-3)
>>> depth.value, depth.convert_to_raw(45)
(40.0, 0.045)
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from rclpy.parameter import Parameter as RosParameter

from us_sim.errors import SettingsError
from us_sim.settings.spelling import short_repr

_DIGITS = 12  # of a number that is shown: fewer than a float has, so that rounding is not seen
_AT_THE_END = 1e-11  # how far from the end of its range, relatively, a number may be by rounding
_NAMES = {"m mode": "M-mode", "nyquist": "Nyquist"}  # that are written otherwise than other words
_WHOLE = 2**63  # whole numbers from here on do not fit into a parameter


class ParameterKind(Enum):
    """The types of parameters that have a control; it is known by the name of the kind."""

    TRUTH = RosParameter.Type.BOOL
    WHOLE = RosParameter.Type.INTEGER
    NUMBER = RosParameter.Type.DOUBLE
    TEXT = RosParameter.Type.STRING
    WHOLES = RosParameter.Type.INTEGER_ARRAY
    NUMBERS = RosParameter.Type.DOUBLE_ARRAY
    TEXTS = RosParameter.Type.STRING_ARRAY
    OTHER = RosParameter.Type.NOT_SET

    @classmethod
    def _missing_(cls, _: object) -> ParameterKind:
        return cls.OTHER

    @property
    def is_list(self) -> bool:
        """Whether its value is a tuple."""
        return self in (ParameterKind.WHOLES, ParameterKind.NUMBERS, ParameterKind.TEXTS)


@dataclass(frozen=True)
class Parameter:
    """A parameter of a node, with its value as the node has it and as a person reads it."""

    node: str  # name within the namespace
    name: str
    kind: ParameterKind
    raw: Any  # in SI units; lists are tuples
    unit: str = ""  # that a person reads
    size: float = 1.0  # SI units in one of ``unit``
    limits: tuple[float, float] | None = None  # in SI units
    choices: tuple[str, ...] = ()  # the only texts that will do
    meanings: Mapping[str, str] = field(default_factory=dict)  # of choices, as far as told
    may_be_nothing: bool = False  # and is where ``raw`` is 0, empty, or a list of those
    description: str = ""
    is_live: bool = True  # may change while the node runs

    @property
    def value(self) -> Any:
        """In ``unit``; None is nothing."""
        is_nothing = not any(self.raw) if isinstance(self.raw, tuple) else self.raw in (0, "")
        if self.may_be_nothing and is_nothing:
            return None
        if self.kind is ParameterKind.NUMBERS:
            return tuple(map(self._shown, self.raw))
        return self._shown(self.raw) if self.kind is ParameterKind.NUMBER else self.raw

    @property
    def low(self) -> float | None:
        """The smallest number that will do, in ``unit``."""
        return self._shown(self.limits[0]) if self.limits else None

    @property
    def high(self) -> float | None:
        """The largest number that will do, in ``unit``."""
        return self._shown(self.limits[1]) if self.limits else None

    @property
    def group(self) -> str:
        """Its name up to the last dot."""
        return self.name.rpartition(".")[0]

    @property
    def label(self) -> str:
        """The last part of its name in words."""
        return format_name(self.name.rpartition(".")[2])

    def convert_to_raw(self, value: Any) -> Any:
        """Convert a value that a person has set, in ``unit``, to SI units.

        Raises:
            SettingsError: it is no value of this kind, or outside the range.
        """
        if value is None or (value == "" and self.kind is not ParameterKind.TEXT):
            if not self.may_be_nothing:
                raise SettingsError(f"{self.label} needs a value")
            is_numbers = self.kind is ParameterKind.NUMBERS
            return (0.0,) * max(1, len(self.raw)) if is_numbers else type(self.raw)()
        if self.kind in (ParameterKind.WHOLE, ParameterKind.NUMBER):
            return self._in_range(self._number(value))
        if self.kind.is_list and isinstance(value, list | tuple):
            return tuple(map(str if self.kind is ParameterKind.TEXTS else self._number, value))
        if isinstance(
            value, {ParameterKind.TRUTH: bool, ParameterKind.TEXT: str}.get(self.kind, ())
        ):
            return value
        raise SettingsError(f"{self.label}: {short_repr(value)} is not what it can be set to")

    def with_raw(self, raw: Any) -> Parameter:
        """Return the parameter after it was set."""
        return dataclasses.replace(self, raw=raw)

    def _shown(self, number: float) -> float:
        return float(f"{number / self.size:.{_DIGITS}g}")

    def _number(self, value: Any) -> float | int:
        """Convert a number to SI units; it stays whole where the kind is."""
        try:
            number = float(value)
        except (TypeError, ValueError, OverflowError):
            number = math.nan
        if isinstance(value, bool) or not math.isfinite(number):
            raise SettingsError(f"{self.label}: {short_repr(value)} is not a number")
        if self.kind in (ParameterKind.WHOLE, ParameterKind.WHOLES):
            if number != int(number) or abs(number) >= _WHOLE:
                raise SettingsError(f"{self.label}: {number:g} is not a whole number below 2^63")
            return int(number)
        per_unit = round(1.0 / self.size)
        if per_unit > 1 and math.isclose(1.0 / self.size, per_unit, rel_tol=1e-15):
            number /= per_unit  # 7 mm / 1000 is the float 0.007, and 7 · 1e-3 is not
        else:
            number *= self.size
        ends = (e for e in self.limits or () if math.isclose(number, e, rel_tol=_AT_THE_END))
        return next(ends, number)

    def _in_range(self, raw: Any) -> Any:
        if self.limits and not self.limits[0] <= raw <= self.limits[1]:
            unit = f" {self.unit}" if self.unit else ""
            raise SettingsError(
                f"{self._shown(raw):g}{unit} is outside {self.low:g} to {self.high:g}{unit}"
            )
        return raw


def format_name(name: str) -> str:
    """Write the name of a parameter or a group as a person reads it.

    >>> format_name("colour.nyquist_velocity"), format_name("m_mode")
    ('colour · Nyquist velocity', 'M-mode')
    """
    words = name.replace("_", " ").replace(".", " · ")
    for plain, written in _NAMES.items():
        words = words.replace(plain, written)
    return words
