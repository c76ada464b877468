"""The noise of the electronics: as strong everywhere, until the time gain lifts it with the echoes.

Its envelope is Rayleigh distributed, and is as coarse as the pulse is long and beams are apart. It
is another one from pose to pose, and the same whenever a pose is the same.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Pose
from us_sim.slicing.formation.grey_levels import GREYS_PER_DECIBEL
from us_sim.slicing.formation.imaging import ECHO_RANGE
from us_sim.slicing.probe.probe import Probe

_FRAMES = 4
_GRAIN = (0.8, 1.4)  # standard deviations in pixels, along columns and rows


class Noise:
    """Images of noise that is ``level`` dB at the face, and rises by ``rise`` dB/m."""

    def __init__(self, probe: Probe, level: float, rise: float) -> None:
        distance = probe.pixel_beams[1]
        shown = np.isfinite(distance)
        mean = level + rise * np.nan_to_num(distance)
        random = np.random.Generator(np.random.PCG64(5))
        self._frames = [self._frame(random, mean, shown) for _ in range(_FRAMES)]

    @staticmethod
    def _frame(
        random: np.random.Generator, mean: NDArray[np.float32], shown: NDArray[np.bool_]
    ) -> NDArray[np.uint8]:
        power = np.zeros(mean.shape, dtype=np.float32)
        for _ in range(2):  # in phase and in quadrature
            wave = random.standard_normal(mean.shape, dtype=np.float32)
            wave = np.asarray(cv2.GaussianBlur(wave, (0, 0), _GRAIN[0], sigmaY=_GRAIN[1]))
            power += wave * wave
        power /= power.mean()
        level = mean + 10.0 * np.log10(np.maximum(power, 1e-4)) + ECHO_RANGE
        grey = np.clip(level * GREYS_PER_DECIBEL, 0.0, 255.0)
        grey[~shown] = 0.0
        return grey.astype(np.uint8)

    def at(self, pose: Pose) -> NDArray[np.uint8]:
        """(rows, columns) grey levels with the probe at a pose."""
        bits = np.concatenate([pose.position, pose.orientation]).view(np.uint64)
        return self._frames[int(np.bitwise_xor.reduce(bits) % np.uint64(251)) % _FRAMES]
