"""Colour Doppler: the velocity of blood in a box of the image, as a scanner estimates it.

A scanner sends a few pulses along each beam and looks how far the echo's phase turns from one to
the next: by pi v / n for a velocity v along the beam and the Nyquist velocity n. It averages the
turn over pulses and places as complex numbers R, and shows arg R (C. Kasai, K. Namekawa, A. Koyano,
R. Omoto, Real-time two-dimensional blood flow imaging using an autocorrelation technique, IEEE
Trans. Sonics Ultrason. 32, 1985). So a velocity beyond n shows as one of the other sign, and where
blood of both is in one place they cancel. Here R is made from velocities that are known:

    R = w(v) exp(i pi v / n), averaged over the resolution, plus noise,

with a wall filter w, which takes what is as slow as tissue, and complex normal noise; beams whose
part of the face is in air have no signal. Part of the
noise is proportional to R, as blood moves through the beam and is not the same from pulse to pulse
(spectral broadening), part is not (the receiver's); both fall with the square root of the number of
pulses. Places where R stays below a level show no colour, and gain lowers that.
"""

from __future__ import annotations

import math
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.errors import ProbeError
from us_sim.kernels import njit
from us_sim.slicing.drawing.overlay import ColourScale
from us_sim.slicing.flow.absence import Absence, absence
from us_sim.slicing.flow.blood import Blood, Window
from us_sim.slicing.flow.colour_settings import ColourSettings
from us_sim.slicing.flow.noise import normal_pair
from us_sim.slicing.frame import Frame
from us_sim.slicing.probe.beam_places import (
    beam_angles,
    fractions_and_depths,
    pixels_of,
    require_depth,
    require_steering,
)
from us_sim.slicing.probe.probe import LinearProbe, Probe

_SHOWN = 0.3
"""Size of R, over that of fast blood, from which colour is shown with a gain of 0 dB."""

_BROADENING, _RECEIVER = 0.35, 0.15
"""Standard deviation of the noise for one pulse, over R and over that of fast blood."""

_COLOURS = (
    *((150, 255, 255), (40, 160, 255), (0, 80, 255), (0, 20, 220), (0, 0, 110)),
    *((110, 0, 0), (220, 0, 0), (255, 60, 0), (255, 150, 20), (255, 255, 130)),
)
"""From the fastest away from the probe to the fastest towards it: blue away, red towards."""

_COLOURED = 0.002  # of the box: less is noise
_FORGOTTEN = 0.5  # s after which the frames before do not count
_EDGE = 24  # points along each side of the box


class ColourDoppler:
    """Estimates velocities in the colour box of one probe's images.

    Args:
        probe: its geometry.
        settings: of the box.

    Raises:
        ProbeError: the box is outside the image, or this probe cannot be steered.
    """

    def __init__(self, probe: Probe, settings: ColourSettings) -> None:
        self.settings = settings
        self._probe = probe
        require_steering(probe, "colour.steering", settings.steering)
        depth = require_depth(probe, "colour.depth", settings.depth, "the middle of the box")
        height = 0.5 * probe.depth if settings.height is None else settings.height
        self._top, self._bottom = max(0.0, depth - 0.5 * height), depth + 0.5 * height
        self._bottom = min(self._bottom, probe.depth)
        self._left = max(-0.5, settings.lateral - 0.5 * settings.width)
        self._right = min(0.5, settings.lateral + 0.5 * settings.width)
        self._depth = depth
        self._lay_out()
        self._before: NDArray[np.float32] | None = None
        self._time = 0.0

    @property
    def scale(self) -> ColourScale:
        """Red towards the probe, blue away, black where blood stands."""
        nyquist = self.settings.nyquist_velocity
        return ColourScale("velocity", -nyquist, nyquist, "cm/s", factor=100.0, colours=_COLOURS)

    @cached_property
    def outline(self) -> NDArray[np.float64]:
        """(N, 2) column and row of the corners of a closed line around the box."""
        left, right, top, bottom = self._left, self._right, self._top, self._bottom
        part = np.linspace(0.0, 1.0, _EDGE)
        ahead, back = np.full(_EDGE, 0.0) + part, 1.0 - part
        fraction = np.concatenate([left + (right - left) * ahead, np.full(_EDGE, right),
                                   left + (right - left) * back, np.full(_EDGE, left)])  # fmt: skip
        depth = np.concatenate([np.full(_EDGE, top), top + (bottom - top) * ahead,
                                np.full(_EDGE, bottom), top + (bottom - top) * back])  # fmt: skip
        return pixels_of(self._probe, fraction + self._lean(depth), depth)

    def truth(self, blood: Blood, frame: Frame) -> NDArray[np.float32]:
        """m/s along the box's beams towards the probe, at all pixels; NaN outside lumens."""
        return blood.velocity(frame, self._whole)

    def estimate(self, blood: Blood, frame: Frame) -> NDArray[np.float32]:
        """m/s towards the probe (rows, columns) as estimated; NaN where no colour is shown.

        Noise is a function of the frame's time and the place.
        """
        settings = self.settings
        turned = np.empty((*self._window.shape, 2), dtype=np.float32)
        velocity = blood.velocity(frame, self._window)
        _turn(velocity, settings.nyquist_velocity, settings.wall_filter, turned)
        if frame.contact is not None:
            turned *= frame.contact[0][self._lines][..., None]
        for _ in range(2):  # twice even is a triangle, half as high at its width apart
            cv2.blur(turned, self._cell, turned, borderType=cv2.BORDER_CONSTANT)
        since, self._time = frame.time - self._time, frame.time
        if self._before is not None and settings.persistence > 0.0 and 0.0 <= since < _FORGOTTEN:
            turned = np.asarray(
                cv2.addWeighted(
                    turned, 1.0 - settings.persistence, self._before, settings.persistence, 0.0
                )
            )
        self._before = turned
        noise = np.empty((*self._noise_shape, 2), dtype=np.float32)
        _fill_noise(np.uint64(round(frame.time * 1e6)), noise)
        noise = np.asarray(cv2.resize(noise, self._window.shape[::-1]))
        shown = np.full((self._probe.rows, self._probe.columns), np.nan, dtype=np.float32)
        row, column = self._corner
        rows, columns = self._window.shape
        scale = 1.0 / math.sqrt(settings.pulses)
        _show(
            turned, noise, self._within, settings.nyquist_velocity,
            _SHOWN * 10.0 ** (-settings.gain / 20.0), _BROADENING * scale, _RECEIVER * scale,
            shown[row : row + rows, column : column + columns],
        )  # fmt: skip
        return shown

    def absence(self, blood: Blood, frame: Frame, shown: NDArray[np.float32]) -> Absence:
        """Why an estimate of this frame shows no colour; nothing where it does."""
        if np.count_nonzero(np.isfinite(shown)) > _COLOURED * self._within.sum():
            return Absence.NOTHING
        return absence(blood, frame, self._window, self._lines, self.settings.wall_filter)

    @cached_property
    def _whole(self) -> Window:
        fraction, _ = fractions_and_depths(self._probe)
        return Window(self._probe, beam_angles(self._probe, fraction, self.settings.steering))

    def _lean(self, depth: NDArray[np.float64] | NDArray[np.float32]) -> NDArray[np.float64]:
        """By how much a steered beam has moved across, as a fraction, from the box's middle."""
        if not isinstance(self._probe, LinearProbe):
            return np.zeros_like(depth)
        slope = math.tan(self.settings.steering) / self._probe.aperture
        return np.asarray((depth - self._depth) * slope)

    def _lines_of(
        self, fraction: NDArray[np.float32], depth: NDArray[np.float32]
    ) -> NDArray[np.intp]:
        """The line at whose place on the face the steered beam of each pixel starts."""
        probe = self._probe
        start = np.nan_to_num(fraction)
        if isinstance(probe, LinearProbe):
            start = start - depth * math.tan(self.settings.steering) / probe.aperture
        return np.clip(np.rint((start + 0.5) * probe.lines - 0.5), 0, probe.lines - 1).astype(int)

    def _lay_out(self) -> None:
        """Find the pixels of the box."""
        fraction, depth = fractions_and_depths(self._probe)
        start = fraction - self._lean(depth)
        with np.errstate(invalid="ignore"):
            within = (start >= self._left) & (start <= self._right)
            within &= (depth >= self._top) & (depth <= self._bottom)
        rows, columns = np.flatnonzero(within.any(axis=1)), np.flatnonzero(within.any(axis=0))
        if not (len(rows) and len(columns)):
            raise ProbeError("colour.width: no pixel of the image lies in the box: make it larger")
        box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        self._within = np.ascontiguousarray(within[box])
        self._corner = int(rows[0]), int(columns[0])
        self._lines = self._lines_of(fraction[box], depth[box])
        angles = beam_angles(self._probe, fraction[box], self.settings.steering)
        self._window = Window(self._probe, angles, corner=self._corner)
        # Beyond the box nothing is computed, as no beams go there.
        self._window.pixel[~self._within.ravel()] = -1
        cell = self.settings.resolution / self._probe.pixel_spacing
        across, along = np.maximum(1, np.rint(cell)).astype(int).tolist()
        self._cell = across, along
        size = np.maximum(1.0, cell)[::-1]
        self._noise_shape = np.maximum(1, np.ceil(self._within.shape / size)).astype(int)


@njit(cache=True, nogil=True, error_model="numpy")
def _turn(velocity, nyquist, wall, turned):
    """Fills turned (rows, columns, 2): real and imaginary part of a place's R, without noise."""
    for row in range(velocity.shape[0]):
        for column in range(velocity.shape[1]):
            v = velocity[row, column]
            turned[row, column, 0] = 0.0
            turned[row, column, 1] = 0.0
            if not np.isnan(v):
                # What the filter sees is aliased, too.
                seen = v - 2.0 * nyquist * np.round(v / (2.0 * nyquist))
                fast = seen**4
                weight = fast / (fast + wall**4) if fast > 0.0 else 0.0
                angle = np.pi * v / nyquist
                turned[row, column, 0] = weight * np.cos(angle)
                turned[row, column, 1] = weight * np.sin(angle)


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_noise(seed, noise):
    """Fills noise (rows, columns, 2) with independent normal numbers of variance 1/2."""
    for row in range(noise.shape[0]):
        for column in range(noise.shape[1]):
            place = np.uint64(row) * np.uint64(65536) + np.uint64(column)
            one, other = normal_pair(seed, place)
            noise[row, column, 0] = one * np.sqrt(0.5)
            noise[row, column, 1] = other * np.sqrt(0.5)


@njit(cache=True, nogil=True, error_model="numpy")
def _show(turned, noise, within, nyquist, least, broadening, receiver, shown):
    """Fills shown (rows, columns) with velocities where R with its noise is large enough."""
    for row in range(within.shape[0]):
        for column in range(within.shape[1]):
            if not within[row, column]:
                continue
            x = turned[row, column, 0]
            y = turned[row, column, 1]
            scale = broadening * np.sqrt(x * x + y * y) + receiver
            x += scale * noise[row, column, 0]
            y += scale * noise[row, column, 1]
            if x * x + y * y >= least * least:
                shown[row, column] = nyquist / np.pi * np.arctan2(y, x)
