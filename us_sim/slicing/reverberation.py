"""What lines show that are not, or badly, coupled to the skin: the face's own echoes.

Air reflects everything, so the pulse runs to and fro in the lens of the transducer: bright bands
a lens apart, each weaker than the one before, and a haze below them. A line that is partly
coupled is weaker by so many decibels all the way down, and shows the bands the fainter. Of two
echoes at one place the stronger is shown: their sum is 3 dB more at most.

>>> import numpy as np
>>> from us_sim.slicing.imaging import Imaging
>>> from us_sim.slicing.probe import LinearProbe
>>> from us_sim.slicing.reverberation import Reverberation
>>> probe = LinearProbe(aperture=0.04, depth=0.04, columns=8, rows=8, lines=8)
>>> tissue = np.full((8, 8), 150, dtype=np.uint8)
>>> air = Reverberation(probe, Imaging(contact=True))
>>> air.shown(tissue, np.full(8, 0.5, np.float32))[7]  # 6 dB less
array([124, 124, 124, 124, 124, 124, 124, 124], dtype=uint8)
>>> int(air.shown(tissue, np.zeros(8, np.float32))[7].max())  # nothing but air
0
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from us_sim.slicing.imaging import ECHO_RANGE, Imaging
from us_sim.slicing.probe import Probe

__all__ = ["BAND_SPACING", "Reverberation"]

BAND_SPACING = 1.2e-3
"""m: how thick a lens of 0.8 mm seems, which sound crosses at 1000 m/s instead of 1540."""

_BAND_LOSS = 5.0  # dB, of each passage
_BAND_LENGTH = 0.2e-3  # m, standard deviation of the first band
_BAND_GROWTH = 0.12  # of the length, with each passage
_HAZE = -26.0  # dB, of the haze at the face from the first band
_HAZE_LOSS = 1.0e3  # dB/m
_APERTURE = 1.0e-3  # m, standard deviation of the part of the face that forms a line
_FINE = 8  # places between lines at which their coupling is tabulated
_GREYS_PER_DECIBEL = 255.0 / ECHO_RANGE
_SILENT = 255  # grey values of loss that leave nothing


class Reverberation:
    """Weakens lines by their coupling, and shows the face's echoes in those with air."""

    def __init__(self, probe: Probe, imaging: Imaging) -> None:
        self._air = _air_echoes(probe, imaging.reverberation)
        place = np.nan_to_num((probe.pixel_beams[0] + np.float32(0.5)) * np.float32(_FINE))
        last = _FINE * probe.lines - 1
        self._place = np.clip(place, 0, last).astype(np.uint16)  # (rows, columns)
        self._at = (np.arange(last + 1) + 0.5) / _FINE - 0.5
        self._aperture = _aperture(probe)

    def shown(self, image: NDArray[np.uint8], coupling: NDArray[np.float32]) -> NDArray[np.uint8]:
        """Echo levels (rows, columns) as lines of this coupling (lines,) show them.

        Each line is formed by the elements around it, so by the coupling of all of them.
        """
        if coupling.min() >= 1.0:
            return image
        half = len(self._aperture) // 2
        formed = np.convolve(np.pad(coupling, half, mode="edge"), self._aperture, mode="valid")
        formed = np.interp(self._at, np.arange(len(coupling)), formed)
        losses = _losses(formed) | _losses((1.0 - formed) ** 4) << 8
        out = np.empty_like(image)
        air, place = self._air.reshape(-1), self._place.reshape(-1)
        _brighter(image.reshape(-1), air, place, losses, out.reshape(-1))
        return out


def _losses(amplitude: NDArray[np.float64]) -> NDArray[np.uint32]:
    """The grey values by which echoes of these amplitudes (n,) are fainter."""
    decibels = -20.0 * np.log10(np.maximum(amplitude, 1e-6))
    return np.minimum(np.round(decibels * _GREYS_PER_DECIBEL), _SILENT).astype(np.uint32)


def _air_echoes(probe: Probe, first: float) -> NDArray[np.uint8]:
    """(rows, columns) levels of what a face in air shows, its first band at ``first`` dB."""
    line, depth = np.nan_to_num(probe.pixel_beams)
    # Elements differ a little; what differs is the same in every frame.
    random = np.random.Generator(np.random.PCG64(7))
    grain = random.random((probe.samples, probe.lines), dtype=np.float32)
    grain += np.roll(grain, 1, axis=1)
    sample = np.clip(depth * (probe.samples / probe.depth), 0, probe.samples - 1).astype(np.intp)
    texture = grain[sample, np.clip(line + 0.5, 0, probe.lines - 1).astype(np.intp)]
    amplitude = 0.5 * texture * 10.0 ** ((_HAZE - _HAZE_LOSS * depth) / 20.0)
    for passage in range(1, 1 + int(ECHO_RANGE / _BAND_LOSS)):
        length = _BAND_LENGTH * (1.0 + _BAND_GROWTH * passage)
        away = (depth - (passage - 0.5) * BAND_SPACING) / length
        level = 10.0 ** (-_BAND_LOSS * (passage - 1) / 20.0)
        amplitude += (0.85 + 0.15 * texture) * level * np.exp(-0.5 * away * away)
    level = (first + ECHO_RANGE + 20.0 * np.log10(np.maximum(amplitude, 1e-6))) * _GREYS_PER_DECIBEL
    level[np.isnan(probe.pixel_beams[0])] = 0.0
    return np.clip(level + 0.5, 0.0, 255.0).astype(np.uint8)


def _aperture(probe: Probe) -> NDArray[np.float64]:
    """(odd,) weights, which sum to 1, of the lines around one whose elements form it too."""
    length = np.linalg.norm(np.diff(probe.beam_starts, axis=0), axis=1).sum()
    sigma = _APERTURE / max(length / max(probe.lines - 1, 1), 1e-9)
    half = int(min(np.ceil(2.5 * sigma), probe.lines))
    weights = np.exp(-0.5 * (np.arange(-half, half + 1) / sigma) ** 2)
    return np.asarray(weights / weights.sum())


@njit(cache=True, nogil=True, error_model="numpy")
def _brighter(image, air, place, losses, out):
    """The brighter of tissue and air (flat), each less its loss at its place."""
    for i in range(len(image)):
        loss = losses[place[i]]
        tissue = np.int32(image[i]) - np.int32(loss & 255)
        echo = np.int32(air[i]) - np.int32(loss >> 8)
        out[i] = max(tissue, echo, np.int32(0))
