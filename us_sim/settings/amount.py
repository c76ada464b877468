"""Numbers as a person reads them: in a handy unit, and still exactly the number.

>>> from us_sim.settings.amount import amount, span
>>> from us_sim.settings.quantity import Quantity
>>> amount(0.0003, "length"), amount(12e3, "pressure"), amount(2.0, "number")
('0.3 mm', '12 kPa', '2')
>>> span(Quantity("length", 0.003, 0.2)), span(Quantity("level", -60.0, 0.0))
('3 to 200 mm', '-60 to 0 dB')
>>> dial_unit(Quantity("frequency", 5e5, 5e7)), dial_unit(Quantity("rate", 0.02, 5.0))
('MHz', '/min')
"""

from __future__ import annotations

import math

from us_sim.settings.quantity import Quantity

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
_SLOW = 5.0
"""m/s; speeds up to here, those of blood, are told in cm/s."""
_OF_SOUND = 1e5
"""Hz; frequencies from here on are told in MHz."""

_EXACT = 1e-12
"""How far, relatively, a number in another unit may be from the number: only by rounding."""


def amount(value: float, dimension: str) -> str:
    """The number with its unit, as `Quantity.parse` reads it."""
    number, unit = _split(value, dimension)
    return f"{number} {unit}" if unit else number


def span(quantity: Quantity) -> str:
    """The range of a quantity, with its unit once where both ends have the same."""
    low, low_unit = _split(quantity.minimum, quantity.dimension)
    high, high_unit = _split(quantity.maximum, quantity.dimension)
    if quantity.minimum == 0.0:
        low_unit = high_unit
    if quantity.maximum == 0.0:
        high_unit = low_unit
    if low_unit == high_unit:
        return f"{low} to {high} {high_unit}".rstrip()
    return f"{low} {low_unit} to {high} {high_unit}"


def dial_unit(quantity: Quantity) -> str:
    """The one unit in which all of a quantity's range is shown where a person turns it."""
    dimension = quantity.dimension
    if dimension == "frequency" and quantity.minimum >= _OF_SOUND:
        return "MHz"
    if dimension == "speed" and quantity.maximum <= _SLOW:
        return "cm/s"
    handy = _HANDY.get(dimension, (quantity.unit,))[0]
    return _ON_A_DIAL.get(dimension, handy)


def _split(value: float, dimension: str) -> tuple[str, str]:
    """The number and the unit that read best of those that say the value exactly."""
    si = Quantity(dimension).unit
    if value == 0.0:
        return "0", _HANDY.get(dimension, (si,))[0]
    best = _plain(value), si
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
    """The number in that unit with at most six digits, if that is it."""
    text = f"{value / Quantity(dimension).parse(f'1 {unit}'):.6g}"
    back = Quantity(dimension).parse(f"{text} {unit}")
    return _tidy(text) if math.isclose(back, value, rel_tol=_EXACT) else None


def _plain(value: float) -> str:
    text = f"{value:.6g}"
    if float(text) != value:
        text = repr(value)
    if value == int(value) and abs(value) < 1e8:
        text = str(int(value))
    return _tidy(text)


def _tidy(text: str) -> str:
    """Without the zeros and the plus sign of an exponent."""
    mantissa, e, exponent = text.partition("e")
    return f"{mantissa}e{int(exponent)}" if e else mantissa
