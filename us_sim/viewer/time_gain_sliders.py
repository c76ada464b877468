"""Gains by depth on the sliders of a console, however many gains the images have.

>>> from us_sim.viewer.time_gain_sliders import on_sliders
>>> on_sliders((0.0, 6.0), 4)
[0.0, 2.0, 4.0, 6.0]
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

USUAL, MOST = 8, 12


def slider_count(gains: Sequence[float]) -> int:
    """How many sliders: one for each gain where those are as many as fit, else as consoles have."""
    return len(gains) if 2 < len(gains) <= MOST else USUAL


def on_sliders(gains: Sequence[float], count: int) -> list[float]:
    """Gains at evenly spaced depths, linear in between, as so many sliders show them, dB."""
    if not gains:
        return [0.0] * count
    places = np.linspace(0.0, 1.0, len(gains)) if len(gains) > 1 else np.zeros(1)
    shown = np.interp(np.linspace(0.0, 1.0, count), places, np.asarray(gains, dtype=float))
    return [round(float(gain), 6) for gain in shown]
