"""The pulse of a vessel: how fast blood flows at each moment, over its mean.

At rest an artery of a limb has a triphasic pulse: fast forward flow in systole, a short reversal as
the aortic valve closes, and a slow forward wave after it (W. N. McDicken and P. R. Hoskins, in P.
Hoskins, K. Martin and A. Thrush, Diagnostic Ultrasound: Physics and Equipment, 2nd ed., 2010,
chapter 9). Its shape here is a sum of three bells, moved and scaled so that peak and mean are the
settings' own. Flow in a vein of the arm swings with breathing, and a little with the heart (N.
Baekgaard and C. Strandberg, Duplex ultrasound in the upper limb venous system, Phlebolymphology,
2016): inspiration draws blood into the chest.

>>> import numpy as np
>>> from us_sim.slicing.flow.settings import FlowSettings
>>> from us_sim.slicing.flow.waveform import Waveform
>>> pulse = Waveform(FlowSettings("arterial", (0, 1, 0), peak_velocity=0.8, mean_velocity=0.08))
>>> beat = pulse(np.arange(1000) / 1100)  # one beat at 1.1 a second
>>> round(float(beat.mean()), 3), round(float(beat.max()), 3), round(float(beat.min()), 1)
(1.0, 5.0, -0.7)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.slicing.flow.settings import FlowSettings

_BELLS = ((0.13, 0.045, 1.0), (0.33, 0.06, -0.32), (0.52, 0.09, 0.10))
"""Middle and standard deviation, in beats, and height of the arterial pulse's three waves."""

_CARDIAC = 0.25
"""Fraction of the swing of a vein's flow that is the heart's; the rest is breathing."""

_FINE = 4096  # places at which the pulse's shape is measured


class Waveform:
    """Flow over its mean, as a function of time; its mean over a beat and a breath is 1.

    Args:
        settings: of the vessel's flow.
    """

    def __init__(self, settings: FlowSettings) -> None:
        self._heart, self._breath = settings.heart_rate, settings.respiration_rate
        # A parabolic profile is twice as fast on the axis as in its mean.
        peak = 0.5 * settings.peak_velocity / settings.mean_velocity
        self._is_arterial = settings.kind == "arterial"
        self._swing, self._base = peak - 1.0, 1.0
        if self._is_arterial:
            shape = _triphasic(np.arange(_FINE) / _FINE)
            mean, highest = float(shape.mean()), float(shape.max())
            self._swing = (peak - 1.0) / (highest - mean)
            self._base = 1.0 - self._swing * mean

    def __call__(self, time: ArrayLike) -> NDArray[np.float64]:
        """Flow over its mean at times (any shape) s; beat and breath begin at 0."""
        seconds = np.asarray(time, dtype=np.float64)
        beat = np.mod(seconds * self._heart, 1.0)
        if self._is_arterial:
            return np.asarray(self._base + self._swing * _triphasic(beat))
        swing = _CARDIAC * np.cos(2 * np.pi * beat)
        swing += (1.0 - _CARDIAC) * np.cos(2 * np.pi * np.mod(seconds * self._breath, 1.0))
        return np.asarray(self._base + self._swing * swing)


def _triphasic(beat: NDArray[np.float64]) -> NDArray[np.float64]:
    """The arterial pulse's shape at fractions of a beat, 0 to 1; its peak is about 1."""
    shape = np.zeros_like(beat)
    for middle, width, height in _BELLS:
        apart = np.mod(beat - middle + 0.5, 1.0) - 0.5  # the bell of the beat before, or after
        shape += height * np.exp(-0.5 * (apart / width) ** 2)
    return shape
