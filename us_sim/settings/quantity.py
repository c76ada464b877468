"""Numbers with units: read as a person writes them in a scene, and shown in handy units.

>>> from us_sim.settings.quantity import Quantity, choose_dial_unit, format_quantity, format_range
>>> Quantity("length", minimum=0.0, maximum=1.0).parse("40 mm")
0.04
>>> format_quantity(0.0003, "length"), format_quantity(12e3, "pressure")
('0.3 mm', '12 kPa')
>>> format_range(Quantity("length", 0.003, 0.2)), format_range(Quantity("level", -60.0, 0.0))
('3 to 200 mm', '-60 to 0 dB')
>>> choose_dial_unit(Quantity("frequency", 5e5, 5e7)), choose_dial_unit(Quantity("rate", 0.02, 5.0))
('MHz', '/min')
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from us_sim.settings.spelling import short_repr

_UNITS: dict[str, dict[str, float]] = {
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6},
    "pressure": {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9, "mmHg": 133.322},
    "density": {"kg/m3": 1.0, "kg/m^3": 1.0, "g/cm3": 1e3},
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6},
    "angle": {"rad": 1.0, "deg": math.pi / 180, "°": math.pi / 180},
    "stiffness": {"N/m": 1.0, "N/mm": 1e3},
    "mass per area": {"kg/m2": 1.0, "kg/m^2": 1.0},
    "level": {"dB": 1.0},
    "frequency": {"Hz": 1.0, "kHz": 1e3, "MHz": 1e6},
    "rate": {"Hz": 1.0, "/min": 1 / 60},
    "attenuation": {"dB/cm/MHz": 1.0},
    "acoustic impedance": {"Rayl": 1.0, "MRayl": 1e6},
    "acceleration": {"m/s2": 1.0, "m/s^2": 1.0},
    "speed": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3},
    "angular speed": {"rad/s": 1.0, "deg/s": math.pi / 180, "°/s": math.pi / 180},
    "force": {"N": 1.0, "mN": 1e-3},
    "torque": {"N m": 1.0, "mN m": 1e-3},
    "image distance": {"px": 1.0},
    "cutoff per speed": {"Hz/(m/s)": 1.0},
    "cutoff per angular speed": {"Hz/(rad/s)": 1.0},
    "acceleration noise": {"m/s/√s": 1.0},
    "angular acceleration noise": {"rad/s/√s": 1.0},
    "number": {},
}
_NUMBER = re.compile(r"^\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*$")


def units_of(unit: str) -> dict[str, float]:
    """Return the units of an SI unit's dimension, with their sizes in it; none for other texts."""
    same: dict[str, float] = {}
    for units in _UNITS.values():
        if next(iter(units), None) == unit:
            same |= units
    return same


@dataclass(frozen=True)
class Quantity:
    """A dimension and the range in which a value of it makes sense; SI unless a unit is written."""

    dimension: str
    minimum: float = -math.inf
    maximum: float = math.inf

    @property
    def unit(self) -> str:
        """The SI unit's symbol, or nothing for a plain number."""
        return next(iter(_UNITS[self.dimension]), "")

    def parse(self, value: object) -> float:
        """Convert a value to SI units.

        Raises:
            ValueError: not a number, a unit of another dimension, not finite, or out of range.
        """
        number = self._read_number(value)
        if not math.isfinite(number):
            raise ValueError(f"{short_repr(value)} is not finite; give {self._range}")
        if not self.minimum <= number <= self.maximum:
            given = f"{number:g} {self.unit}".rstrip()
            raise ValueError(f"{given} is outside {self._range}{self._suggest_unit(number)}")
        return number

    def _read_number(self, value: object) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float | str):
            raise ValueError(self._describe_misfit(value))
        if not isinstance(value, str):
            # A whole number may be larger than any that a float holds.
            return float(value) if abs(value) < 1e308 else math.inf
        match, sizes = _NUMBER.match(value), {"": 1.0} | _UNITS[self.dimension]
        if match is None or match[2] not in sizes:
            raise ValueError(self._describe_misfit(value))
        return float(match[1]) * sizes[match[2]]

    @property
    def _range(self) -> str:
        return f"{self.minimum:g} to {self.maximum:g} {self.unit}".rstrip()

    def _describe_misfit(self, value: object) -> str:
        """Say what a value should have been: the dimension and its units."""
        article = "an" if self.dimension[0] in "aeiou" else "a"
        units = list(_UNITS[self.dimension])
        if units:
            hint = f" in {' or '.join(filter(None, [', '.join(units[:-1]), units[-1]]))}"
        else:
            hint = ": it has no unit" if isinstance(value, str) and _NUMBER.match(value) else ""
        return f"{short_repr(value)} is not {article} {self.dimension}{hint}"

    def _suggest_unit(self, number: float) -> str:
        """Suggest the unit that brings the number nearest to mid-range; "" if none does."""
        meant = {
            unit: number * factor
            for unit, factor in _UNITS[self.dimension].items()
            if factor != 1.0 and self.minimum <= number * factor <= self.maximum
        }
        if not meant:
            return ""
        unit = next(iter(meant))
        if self.minimum > 0.0 and math.isfinite(self.maximum):
            middle = math.sqrt(self.minimum * self.maximum)
            unit = min(meant, key=lambda unit: abs(math.log(meant[unit] / middle)))
        return f"; did you mean '{number:g} {unit}'?"


_HANDY = {
    "length": ("mm", "m", "um"),
    "pressure": ("kPa", "Pa", "MPa", "GPa"),
    "time": ("s", "ms", "us"),
    "angle": ("deg", "rad"),
    "frequency": ("Hz", "MHz"),
    "acoustic impedance": ("MRayl", "Rayl"),
}
"""Units that people use, the most usual first; of other dimensions it is the SI unit."""

_ON_A_DIAL = {"rate": "/min", "angular speed": "deg/s"}
"""Units of other dimensions, where a number is turned up and down."""

_EXACT = 1e-12
"""Relative distance of a number in another unit from the number: rounding only."""


def format_quantity(value: float, dimension: str) -> str:
    """Write a number with its unit, so that `Quantity.parse` reads it."""
    return " ".join(_choose_unit(value, dimension)).rstrip()


def format_range(quantity: Quantity) -> str:
    """Write the range of a quantity, with its unit once where both ends have the same."""
    low, low_unit = _choose_unit(quantity.minimum, quantity.dimension)
    high, high_unit = _choose_unit(quantity.maximum, quantity.dimension)
    if quantity.minimum == 0.0:
        low_unit = high_unit
    if quantity.maximum == 0.0:
        high_unit = low_unit
    if low_unit == high_unit:
        return f"{low} to {high} {high_unit}".rstrip()
    return f"{low} {low_unit} to {high} {high_unit}"


def choose_dial_unit(quantity: Quantity) -> str:
    """Choose the one unit in which a control shows all of a quantity's range."""
    dimension = quantity.dimension
    if dimension == "frequency" and quantity.minimum >= 1e5:  # of sound
        return "MHz"
    if dimension == "speed" and quantity.maximum <= 5.0:  # of blood
        return "cm/s"
    if dimension == "pressure" and quantity.maximum <= 1e5:  # of blood
        return "mmHg"
    handy = _HANDY.get(dimension, (quantity.unit,))[0]
    return _ON_A_DIAL.get(dimension, handy)


def _choose_unit(value: float, dimension: str) -> tuple[str, str]:
    """Return the number and the unit that read best among those that state the value exactly."""
    si = Quantity(dimension).unit
    if value == 0.0:
        return "0", _HANDY.get(dimension, (si,))[0]
    best = _format_number(value), si
    handy = [
        (text, unit)
        for unit in _HANDY.get(dimension, ())
        if (text := _in_unit(value, dimension, unit)) is not None
    ]
    for text, unit in handy:
        if 0.1 <= abs(float(text)) < 1000.0:
            return text, unit
    if handy and "e" in best[0]:
        plain = [(text, unit) for text, unit in handy if "e" not in text]
        return min(plain, key=lambda each: len(each[0])) if plain else best
    return best


def _in_unit(value: float, dimension: str, unit: str) -> str | None:
    """Write the number in that unit with at most six digits; None where these are not exact."""
    text = f"{value / Quantity(dimension).parse(f'1 {unit}'):.6g}"
    back = Quantity(dimension).parse(f"{text} {unit}")
    return _tidy(text) if math.isclose(back, value, rel_tol=_EXACT) else None


def _format_number(value: float) -> str:
    if value == int(value) and abs(value) < 1e8:
        return str(int(value))
    text = f"{value:.6g}"
    return _tidy(text if float(text) == value else repr(value))


def _tidy(text: str) -> str:
    mantissa, e, exponent = text.partition("e")
    return f"{mantissa}e{int(exponent)}" if e else mantissa
