"""Parameters of nodes as a page shows them: in the unit that a person reads, with their ranges.

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

_DIGITS = 12  # of a shown number: fewer than a float has, which hides rounding
_AT_THE_END = 1e-11  # relative distance from an end of the range that counts as rounding
_NAMES = {"m mode": "M-mode", "nyquist": "Nyquist"}  # words with a spelling of their own
_WHOLE = 2**63  # the smallest whole number that does not fit into a parameter


class ParameterKind(Enum):
    """Kinds of parameters; the page's control goes by the name of the kind."""

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
        """True if the value is a tuple."""
        return self in (ParameterKind.WHOLES, ParameterKind.NUMBERS, ParameterKind.TEXTS)


@dataclass(frozen=True)
class Parameter:
    """A parameter of a node, with its value in SI units and in the unit that a person reads."""

    node: str  # name within the namespace
    name: str
    kind: ParameterKind
    raw: Any  # in SI units; lists are tuples
    unit: str = ""  # that a person reads
    size: float = 1.0  # of one ``unit`` in SI units
    limits: tuple[float, float] | None = None  # in SI units
    choices: tuple[str, ...] = ()  # the only valid texts, if any
    meanings: Mapping[str, str] = field(default_factory=dict)  # of choices, as far as known
    may_be_nothing: bool = False  # 0, an empty text, or a list of these mean nothing
    description: str = ""
    is_live: bool = True  # may change while the node runs

    @property
    def value(self) -> Any:
        """The value in ``unit``; None is nothing."""
        is_nothing = not any(self.raw) if isinstance(self.raw, tuple) else self.raw in (0, "")
        if self.may_be_nothing and is_nothing:
            return None
        if self.kind is ParameterKind.NUMBERS:
            return tuple(map(self._convert_to_shown, self.raw))
        return self._convert_to_shown(self.raw) if self.kind is ParameterKind.NUMBER else self.raw

    @property
    def low(self) -> float | None:
        """The smallest valid number, in ``unit``."""
        return self._convert_to_shown(self.limits[0]) if self.limits else None

    @property
    def high(self) -> float | None:
        """The largest valid number, in ``unit``."""
        return self._convert_to_shown(self.limits[1]) if self.limits else None

    @property
    def group(self) -> str:
        """The name up to the last dot."""
        return self.name.rpartition(".")[0]

    @property
    def label(self) -> str:
        """The last part of the name, in words."""
        return format_name(self.name.rpartition(".")[2])

    def convert_to_raw(self, value: Any) -> Any:
        """Convert a value that a person has set, in ``unit``, to SI units.

        Raises:
            SettingsError: the value has another kind, or is outside the range.
        """
        if value is None or (value == "" and self.kind is not ParameterKind.TEXT):
            if not self.may_be_nothing:
                raise SettingsError(f"{self.label} needs a value")
            is_numbers = self.kind is ParameterKind.NUMBERS
            return (0.0,) * max(1, len(self.raw)) if is_numbers else type(self.raw)()
        if self.kind in (ParameterKind.WHOLE, ParameterKind.NUMBER):
            return self._require_in_range(self._read_number(value))
        if self.kind.is_list and isinstance(value, list | tuple):
            return tuple(map(str if self.kind is ParameterKind.TEXTS else self._read_number, value))
        types = {ParameterKind.TRUTH: bool, ParameterKind.TEXT: str}
        if isinstance(value, types.get(self.kind, ())):
            return value
        raise SettingsError(f"{self.label}: {short_repr(value)} is not what it can be set to")

    def with_raw(self, raw: Any) -> Parameter:
        """Return the parameter with another value, in SI units."""
        return dataclasses.replace(self, raw=raw)

    def _convert_to_shown(self, number: float) -> float:
        return float(f"{number / self.size:.{_DIGITS}g}")

    def _read_number(self, value: Any) -> float | int:
        """Convert a number in ``unit`` to SI units; of a whole kind it must be whole."""
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

    def _require_in_range(self, raw: Any) -> Any:
        if self.limits and not self.limits[0] <= raw <= self.limits[1]:
            unit = f" {self.unit}" if self.unit else ""
            shown = f"{self._convert_to_shown(raw):g}{unit}"
            raise SettingsError(f"{shown} is outside {self.low:g} to {self.high:g}{unit}")
        return raw


def format_name(name: str) -> str:
    """Write the name of a parameter or a group for a person.

    >>> format_name("colour.nyquist_velocity"), format_name("m_mode")
    ('colour · Nyquist velocity', 'M-mode')
    """
    words = name.replace("_", " ").replace(".", " · ")
    for plain, written in _NAMES.items():
        words = words.replace(plain, written)
    return words
