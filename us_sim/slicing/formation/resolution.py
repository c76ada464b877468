"""The point spread function: the width of the beam and the length of the pulse at every depth.

Echoes are spread as power. Scatterers within a beam send echoes of random phase, whose expected
power is the sum of theirs (Wagner, Smith, Sandrik, Lopez 1983). So tissue keeps its brightness, and
6 dB below its peak a point is as wide as the setting says. A volume of grey values holds no phases,
so speckle finer than the beam becomes smoother, where a scanner's is coarser.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.kernels import njit
from us_sim.slicing.probe.beams import compute_beam_width, get_focus
from us_sim.slicing.probe.probe import LinearProbe, Probe
from us_sim.slicing.settings import ECHO_RANGE, Imaging

_SIGMA_PER_WIDTH = 1 / (4 * math.sqrt(math.log(2)))
"""Standard deviation of an amplitude over the width at half its power. Power is the square of the
amplitude, and its standard deviation is √2 times less."""

_REACH = 3.0  # standard deviations after which the point spread counts as 0

# 1/m: attenuation takes the high frequencies, so 10 cm deep the pulse is twice as long.
_PULSE_GROWTH = 10.0

_FINEST = 1 << 16  # entries of the table of levels; a step is a 65th of the faintest amplitude
_LINE_STEP = 1.0  # pixels between the lines of a fan that is resampled, where they are widest


class Resolution:
    """Spreads echoes across and along the beams.

    Across them the width is ``lateral_resolution`` at the focus and grows away from it as
    `beams.compute_beam_width` says; along them it is ``axial_resolution`` at the face and grows by
    a tenth of that each centimetre.

    Where beams are parallel, an image's columns and rows serve as lines and samples. A fan is
    resampled to lines and samples so close that no pixel falls between them, and back.
    """

    def __init__(self, probe: Probe, imaging: Imaging) -> None:
        self._fan = None if isinstance(probe, LinearProbe) else _Fan(probe)
        if self._fan is None:
            lines, samples = probe.columns, probe.rows
            line_spacing: Any = probe.pixel_spacing[0]
        else:
            lines, samples = self._fan.lines, self._fan.samples
            line_spacing = self._fan.line_spacing
        sample_spacing = probe.depth / samples
        depths = (np.arange(samples) + 0.5) * sample_spacing
        across = (
            compute_beam_width(depths, imaging.lateral_resolution, get_focus(probe)) / line_spacing
        )
        along = imaging.axial_resolution * (1.0 + _PULSE_GROWTH * depths) / sample_spacing
        self._across = _point_spreads(across, lines - 1)
        self._along = _point_spreads(along, samples - 1)

    def spread_echoes(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the image (rows, columns) of echo levels as the probe resolves it."""
        beams = image if self._fan is None else self._fan.resample_to_beams(image)
        power = np.empty(beams.shape, dtype=np.float32)
        _spread_across(beams, _POWERS, *self._across, power)
        out = np.empty_like(beams)
        _spread_along(power, *self._along, _LEVELS, out)
        return out if self._fan is None else self._fan.resample_to_pixels(out)


class _Fan:
    """Resampling between the pixels of a fan and a grid of its beams."""

    def __init__(self, probe: Probe) -> None:
        import cv2

        # As fine as the pixels, however many lines and samples the probe has.
        pixel = math.sqrt(probe.pixel_spacing.prod())
        ends = probe.beam_starts + probe.depth * probe.beam_directions
        widest = max(_length(probe.beam_starts), _length(ends))
        self.lines = max(2, math.ceil(widest / (_LINE_STEP * pixel)))
        self.samples = max(2, round(probe.depth / pixel))
        # Their coordinates among the probe's lines, whose outermost are half a line from the edge.
        number = np.arange(probe.lines)
        line = (np.arange(self.lines) + 0.5) * (probe.lines / self.lines) - 0.5
        starts, directions = (
            np.column_stack([np.interp(line, number, column) for column in array.T])
            for array in (probe.beam_starts, probe.beam_directions)
        )
        depths = (np.arange(self.samples) + 0.5) * (probe.depth / self.samples)
        x, z = (starts[:, i] + depths[:, None] * directions[:, i] for i in range(2))
        between = np.hypot(np.diff(x, axis=1), np.diff(z, axis=1))
        self.line_spacing = np.maximum(np.median(between, axis=1), 1e-9)
        lateral, axial = probe.pixel_spacing
        left, top = probe.image_to_probe[[0, 2], 3]
        self._to_beams = cv2.convertMaps(
            ((x - left) / lateral).astype(np.float32),
            ((z - top) / axial).astype(np.float32),
            cv2.CV_16SC2,
        )
        line_of, distance = probe.pixel_beams
        shown = np.isfinite(distance)
        line_of = (line_of + 0.5) * (self.lines / probe.lines) - 0.5
        line_of = np.clip(line_of, 0, self.lines - 1)
        sample = np.clip(distance * (self.samples / probe.depth) - 0.5, 0, self.samples - 1)
        self._to_pixels = cv2.convertMaps(
            np.where(shown, line_of, -9).astype(np.float32),
            np.where(shown, sample, -9).astype(np.float32),
            cv2.CV_16SC2,
        )

    def resample_to_beams(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Resample an image (rows, columns) to (samples, lines)."""
        return _remapped(image, self._to_beams, replicate=True)

    def resample_to_pixels(self, beams: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Resample (samples, lines) to an image (rows, columns), black where no beam reaches."""
        return _remapped(beams, self._to_pixels, replicate=False)


def _remapped(image: NDArray[np.uint8], maps: Any, *, replicate: bool) -> NDArray[np.uint8]:
    import cv2

    border = cv2.BORDER_REPLICATE if replicate else cv2.BORDER_CONSTANT
    nearest, fractions = maps
    remapped: Any = cv2.remap(image, nearest, fractions, cv2.INTER_LINEAR, borderMode=border)
    return np.asarray(remapped)


def _length(points: NDArray[np.float64]) -> float:
    count = len(points)
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return float(steps.sum()) * count / max(count - 1, 1)


def _point_spreads(
    widths: NDArray[Any], most: int
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return Gaussian weights of full widths at half maximum (n,) in steps, and their reach.

    Returns:
        (n, reach + 1) weights of a step and those on either side of it, which sum to 1; (n,).
    """
    sigma = np.maximum(widths, 1e-6) * _SIGMA_PER_WIDTH
    reach = np.minimum(np.ceil(_REACH * sigma), most).astype(np.int64)
    reach[widths == 0.0] = 0
    away = np.arange(reach.max() + 1)
    weights = np.exp(-0.5 * (away / sigma[:, None]) ** 2)
    weights[away > reach[:, None]] = 0.0
    weights /= weights[:, :1] + 2 * weights[:, 1:].sum(axis=1, keepdims=True)
    return weights.astype(np.float32), reach


# (256,) power of each grey value, 1 for 255 and nothing for 0.
_POWERS = (10.0 ** ((np.arange(256) / 255.0 - 1.0) * ECHO_RANGE / 10.0)).astype(np.float32)
_POWERS[0] = 0.0
# (`_FINEST` + 1,) grey value of each evenly spaced amplitude from 0 to 1.
_AMPLITUDES = np.maximum(np.arange(_FINEST + 1), 0.25) / _FINEST
_LEVELS = np.floor(255.0 * (1.0 + 20.0 * np.log10(_AMPLITUDES) / ECHO_RANGE) + 0.5)
_LEVELS = np.clip(_LEVELS, 0, 255).astype(np.uint8)


@njit(cache=True, nogil=True, error_model="numpy")
def _spread_across(image, powers, weights, reach, out):
    """Spread the power of grey values (rows, lines) along each row, into ``out``."""
    rows, lines = image.shape
    padded = np.empty(lines + 2 * weights.shape[1], dtype=np.float32)
    for row in range(rows):
        r = reach[row]
        inner = padded[r : r + lines]
        echoes = image[row]
        for i in range(lines):
            inner[i] = powers[echoes[i]]
        for i in range(r):
            padded[i] = inner[0]
            padded[r + lines + i] = inner[lines - 1]
        line = out[row]
        middle = weights[row, 0]
        for i in range(lines):
            line[i] = middle * inner[i]
        for k in range(1, r + 1):
            weight = weights[row, k]
            left = padded[r - k : r - k + lines]
            right = padded[r + k : r + k + lines]
            for i in range(lines):
                line[i] += weight * (left[i] + right[i])


@njit(cache=True, nogil=True, error_model="numpy")
def _spread_along(power, weights, reach, levels, out):
    """Spread power (rows, lines) across rows; write it as grey values to ``out``."""
    rows, lines = power.shape
    line = np.empty(lines, dtype=np.float32)
    finest = np.float32(len(levels) - 1)
    for row in range(rows):
        middle = weights[row, 0]
        own = power[row]
        for i in range(lines):
            line[i] = middle * own[i]
        for k in range(1, reach[row] + 1):
            weight = weights[row, k]
            above = power[max(row - k, 0)]
            below = power[min(row + k, rows - 1)]
            for i in range(lines):
                line[i] += weight * (above[i] + below[i])
        for i in range(lines):
            line[i] = min(np.sqrt(line[i]), np.float32(1.0)) * finest + np.float32(0.5)
        shown = out[row]
        for i in range(lines):
            shown[i] = levels[np.int32(line[i])]
