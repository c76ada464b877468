"""Echoes of the transducer's own face in lines that are badly coupled to the skin.

Air reflects everything, so the pulse runs to and fro in the lens of the transducer: bright bands
a lens apart, each weaker than the one before, and a haze below them.

A line sees the tissue through the elements that form it, and deeper echoes are formed by more
elements. So the shadow of a part of the face without contact reaches all depths, with an edge that
gets softer with depth. A partly coupled line is weaker by the coupling in decibels.
Of two echoes at one place the stronger is shown: their sum is 3 dB more at most.

>>> import numpy as np
>>> from us_sim.slicing.formation.imaging import Imaging
>>> from us_sim.slicing.probe.probe import LinearProbe
>>> from us_sim.slicing.formation.reverberation import Reverberation
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
from numpy.typing import NDArray

from us_sim.kernels import njit
from us_sim.slicing.formation.imaging import ECHO_RANGE, Imaging
from us_sim.slicing.probe.probe import Probe

BAND_SPACING = 1.2e-3
"""m: how thick a lens of 0.8 mm seems, which sound crosses at 1000 m/s instead of 1540."""

_BAND_LOSS = 5.0  # dB, of each passage
_BAND_LENGTH = 0.2e-3  # m, standard deviation of the first band
_BAND_GROWTH = 0.12  # of the length, with each passage
_HAZE = -26.0  # dB, of the haze at the face from the first band
_HAZE_LOSS = 1.0e3  # dB/m
_GRAIN = (512, 192)  # the haze's, along and across the beams
_PLACES = 1024  # along the face, at which coupling is tabulated
_STEPS = 32  # of depth, likewise
_F_NUMBER = 2.0  # depth over the length of face that looks there
_APERTURE = (1.5e-3, 1 / 3)  # m, and fraction of the face: the least and the most that forms a line
_FINEST = 4096  # entries of the table of losses
_GREYS_PER_DECIBEL = 255.0 / ECHO_RANGE
_SILENT = 255  # grey values of loss after which nothing is left


class Reverberation:
    """Weakens lines by their coupling, and shows the face's echoes in those with air."""

    def __init__(self, probe: Probe, imaging: Imaging) -> None:
        line, depth = np.nan_to_num(probe.pixel_beams)
        place = np.clip((line + 0.5) * (_PLACES / probe.lines), 0, _PLACES - 1)
        step = np.clip(depth * (_STEPS / probe.depth), 0, _STEPS - 1)
        self._place = place.astype(np.uint16) + step.astype(np.uint16) * np.uint16(_PLACES)
        self._air = _air_echoes(probe, imaging.reverberation)
        self._line = (np.arange(_PLACES) + 0.5) * (probe.lines / _PLACES) - 0.5
        self._reach = _apertures(probe) // 2
        # With the kernels loaded the first line that loses contact is not late.
        self.shown(np.zeros(self._place.shape, np.uint8), np.zeros(probe.lines, np.float32))

    def shown(self, image: NDArray[np.uint8], coupling: NDArray[np.float32]) -> NDArray[np.uint8]:
        """Echo levels (rows, columns) as lines of this coupling (lines,) show them."""
        if coupling.min() >= 1.0:
            return image
        coupled = np.interp(self._line, np.arange(len(coupling)), coupling)
        losses = np.empty((_STEPS, _PLACES), dtype=np.uint32)
        _lose(np.sqrt(coupled), self._reach, _LOSSES, losses)
        out = np.empty_like(image)
        air, place = self._air.reshape(-1), self._place.reshape(-1)
        _brighter(image.reshape(-1), air, place, losses.reshape(-1), out.reshape(-1))
        return out


def _losses() -> NDArray[np.uint32]:
    """(`_FINEST` + 1,) grey values lost, there and back, at evenly spaced amplitude fractions."""
    fraction = np.maximum(np.arange(_FINEST + 1), 0.1) / _FINEST
    lost = np.round(-40.0 * np.log10(fraction) * _GREYS_PER_DECIBEL)
    return np.minimum(lost, _SILENT).astype(np.uint32)


_LOSSES = _losses()


def _apertures(probe: Probe) -> NDArray[np.int64]:
    """(`_STEPS`,) length of the face, in places, that forms a line at each step of depth."""
    length = np.linalg.norm(np.diff(probe.beam_starts, axis=0), axis=1).sum()
    length = max(length * probe.lines / max(probe.lines - 1, 1), 1e-6)
    depth = (np.arange(_STEPS) + 0.5) * (probe.depth / _STEPS)
    least, most = _APERTURE
    part = np.maximum(np.minimum(depth / _F_NUMBER, most * length), least) / length
    return np.asarray(np.minimum(part, 1.0) * _PLACES).astype(np.int64)


def _air_echoes(probe: Probe, first: float) -> NDArray[np.uint8]:
    """(rows, columns) levels of the image of a face in air, its first band at ``first`` dB."""
    line, depth = np.nan_to_num(probe.pixel_beams)
    # Elements differ a little, in the same manner in every frame.
    random = np.random.Generator(np.random.PCG64(7))
    samples, lines = _GRAIN
    grain = random.random(_GRAIN, dtype=np.float32)
    grain += np.roll(grain, 1, axis=1)
    sample = np.clip(depth * (samples / probe.depth), 0, samples - 1).astype(np.intp)
    element = np.clip((line + 0.5) * (lines / probe.lines), 0, lines - 1).astype(np.intp)
    texture = grain[sample, element]
    amplitude = 0.5 * texture * 10.0 ** ((_HAZE - _HAZE_LOSS * depth) / 20.0)
    for passage in range(1, 1 + int(ECHO_RANGE / _BAND_LOSS)):
        length = _BAND_LENGTH * (1.0 + _BAND_GROWTH * passage)
        away = (depth - (passage - 0.5) * BAND_SPACING) / length
        level = 10.0 ** (-_BAND_LOSS * (passage - 1) / 20.0)
        amplitude += (0.85 + 0.15 * texture) * level * np.exp(-0.5 * away * away)
    level = (first + ECHO_RANGE + 20.0 * np.log10(np.maximum(amplitude, 1e-6))) * _GREYS_PER_DECIBEL
    level[np.isnan(probe.pixel_beams[0])] = 0.0
    return np.clip(level + 0.5, 0.0, 255.0).astype(np.uint8)


@njit(cache=True, nogil=True, error_model="numpy")
def _lose(coupled, reach, losses, out):
    """The losses of tissue and of the face's own echo, at each step of depth and place of the face.

    Args:
        coupled: (places,) fraction of the amplitude transmitted in one direction.
        reach: (steps,) places on either side whose elements form a line.
        losses: the table of losses.
        out: (steps, places), set: the tissue's loss, and that of the face's echo times 256.
    """
    places = len(coupled)
    finest = len(losses) - 1
    own = np.empty(places, dtype=np.uint32)
    total = np.zeros(places + 1)
    for i in range(places):
        total[i + 1] = total[i] + coupled[i]
    for step in range(len(reach)):
        for i in range(places):
            first, end = max(i - reach[step], 0), min(i + reach[step] + 1, places)
            mean = min((total[end] - total[first]) / (end - first), 1.0)
            if step == 0:
                # By the nearest elements; squared, since little contact already quiets the lens.
                own[i] = losses[np.int64((1.0 - mean * mean) ** 2 * finest + 0.5)] << 8
            out[step, i] = own[i] | losses[np.int64(mean * finest + 0.5)]


@njit(cache=True, nogil=True, error_model="numpy")
def _brighter(image, air, place, losses, out):
    """The brighter of tissue and air (flat), each less its loss at its place."""
    for i in range(len(image)):
        loss = losses[place[i]]
        tissue = np.int32(image[i]) - np.int32(loss & 255)
        echo = np.int32(air[i]) - np.int32(loss >> 8)
        out[i] = max(tissue, echo, np.int32(0))
