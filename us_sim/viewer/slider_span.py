"""The part of a parameter's range that a slider covers: a range may span many decades.

>>> from us_sim.viewer.slider_span import slider_span
>>> slider_span(-60.0, 60.0, 6.0)
SliderSpan(low=-60.0, high=60.0, step=0.2, is_logarithmic=False)
>>> slider_span(1e-6, 1e10, 12.0)  # kPa
SliderSpan(low=0.12, high=1200.0, step=0.0, is_logarithmic=True)
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass

_BY_FACTORS = 50.0
"""From the smallest number to the largest: beyond, a slider goes by factors."""
_WIDE = 1000.0
"""Likewise: beyond, a slider covers what is near the present value."""
_AROUND = 100.0
"""Times the present value, and a hundredth of it, where a slider goes by factors."""
_ROOM = 4.0
"""Times the present value, where a slider begins at zero."""
_STEPS = 600
_NOTHING = 1e-12
"""Of the range: a smaller value is zero on a slider."""


@dataclass(frozen=True)
class SliderSpan:
    """What a slider covers."""

    low: float
    high: float
    step: float  # 0 where it goes by factors
    is_logarithmic: bool

    def holds(self, value: float | None) -> bool:
        """Whether a value can be shown on it; nothing can."""
        return value is None or self.low <= value <= self.high


def slider_span(
    low: float, high: float, value: float | None, is_whole: bool = False
) -> SliderSpan | None:
    """What a slider covers around a value; None where no slider makes sense.

    Args:
        low, high: the range, in the unit that is shown.
        value: at present; None is nothing.
        is_whole: only whole numbers will do.
    """
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        return None
    if low > 0.0 and high / low > _BY_FACTORS and not is_whole:
        if value and value > 0.0 and high / low > _WIDE:
            low, high = max(low, value / _AROUND), min(high, value * _AROUND)
        return SliderSpan(low, high, 0.0, True)
    reach = max(abs(low), abs(high))
    if value and abs(value) < _NOTHING * reach:
        value = 0.0
    if value and reach > _WIDE * abs(value):
        end = _round_number(_ROOM * abs(value))
        low, high = max(low, -end), min(high, end)
    elif is_whole and value and high - low > _WIDE:
        high = min(high, _round_number(_ROOM * abs(value)))
    if (high - low) / _STEPS < sys.float_info.min:
        return None
    step = 1.0 if is_whole else _round_number((high - low) / _STEPS)
    return SliderSpan(low, high, step, False)


def _round_number(number: float) -> float:
    """The next of 1, 2, 5 times a power of ten that is not smaller."""
    power = 10.0 ** math.floor(math.log10(number))
    factor = next(f for f in (1.0, 2.0, 5.0, 10.0) if f * power >= number * (1.0 - 1e-9))
    return float(f"{factor * power:.6g}")
