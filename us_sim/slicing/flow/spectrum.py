"""Pulsed-wave Doppler: the spectrum of velocities at a gate, over time.

Each column is the spectrum of one moment: how much blood in the gate has which velocity along the
beam. The beam sees each velocity somewhat spread, the more the faster it is, since blood passes
through the gate in a short time (transit time broadening); and as the echo of many cells is a sum
of random phases, the power in each bin is exponentially distributed around its mean (J. A. Jensen,
Estimation of Blood Velocities Using Ultrasound, 1996, chapters 5 and 6). Velocities beyond the
Nyquist velocity come in at the other end. A person sets the angle between beam and vessel, which
makes velocities along the vessel of those along the beam: divided by its cosine.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import ProbeError
from us_sim.kernels import njit
from us_sim.slicing.drawing.sweep_picture import SweepPicture
from us_sim.slicing.flow.absence import Absence, absence
from us_sim.slicing.flow.blood import Blood, Window
from us_sim.slicing.flow.noise import uniform
from us_sim.slicing.flow.spectrum_settings import SpectrumSettings
from us_sim.slicing.frame import Frame
from us_sim.slicing.probe.beam_places import (
    beam_angles,
    pixels_of,
    require_depth,
    require_steering,
)
from us_sim.slicing.probe.probe import Probe

_ROWS, _COLUMNS = 256, 512
_ALONG, _ACROSS = 15, 7
"""Places in the gate along the beam and across it."""

_BEAM = 1e-3
"""Width of the gate across the beam, m: that of a beam of 5 to 8 MHz at its focus."""

_LEAST_BROADENING, _TRANSIT = 0.012, 0.06
"""Standard deviation of what one velocity is spread over: of the Nyquist velocity, and of the
velocity itself."""

_DRAWN = 3e-3
"""Length of the lines that show the gate, m."""

_NOISE = 1e-4
"""The receiver's power in a bin, over that of a gate full of blood of one slow velocity."""


class Spectrum:
    """The spectrum at a gate of one probe's images.

    Args:
        probe: its geometry.
        settings: of the gate.

    Raises:
        ProbeError: the gate is outside the image, or this probe cannot be steered.
    """

    def __init__(self, probe: Probe, settings: SpectrumSettings) -> None:
        self.settings = settings
        require_steering(probe, "spectrum.steering", settings.steering)
        depth = require_depth(probe, "spectrum.depth", settings.depth, "the gate")
        start = np.array([settings.lateral])
        middle = pixels_of(probe, start, np.array([depth]), settings.steering)[0]
        if not (-0.5 <= middle[0] <= probe.columns - 0.5 and middle[1] <= probe.rows - 0.5):
            raise ProbeError("spectrum.steering: the gate lies beside the image: steer it less")
        angle = float(beam_angles(probe, start, settings.steering)[0])
        along = np.array([math.sin(angle), math.cos(angle)])
        across = np.array([along[1], -along[0]])
        far = settings.size * ((np.arange(_ALONG) + 0.5) / _ALONG - 0.5)
        wide = _BEAM * ((np.arange(_ACROSS) + 0.5) / _ACROSS - 0.5)
        offsets = far[:, None, None] * along + wide[None, :, None] * across
        places = middle + offsets.reshape(-1, 2) / probe.pixel_spacing
        line = round((settings.lateral + 0.5) * probe.lines - 0.5)
        self._line = min(max(line, 0), probe.lines - 1)
        self._window = Window(probe, np.full(len(places), angle), places)
        self.lines = _gate_lines(middle, along, across, settings, probe)
        nyquist, cosine = settings.nyquist_velocity, math.cos(settings.angle_correction)
        self._lowest = nyquist * (settings.baseline - 1.0)
        shown = 100.0 * np.array([self._lowest + 2.0 * nyquist, self._lowest]) / cosine
        self._picture = SweepPicture(
            _ROWS, _COLUMNS, settings.sweep, (float(shown[0]), float(shown[1]), "cm/s")
        )

    def go_on(self, before: Spectrum) -> None:
        """Go on with the picture of a gate that looked elsewhere, if its scales are the same."""
        if before._picture.layout == self._picture.layout:
            self._picture = before._picture

    def show(self, blood: Blood, frame: Frame) -> NDArray[np.uint8]:
        """The picture (rows, columns, 3) up to the frame, with its scales.

        Between two frames the tissue is taken to be as in the later one; the pulse is not.
        """
        moments = self._picture.moments(frame.time)
        self._picture.add(self.columns(blood, frame, moments))
        return self._picture.drawn()

    def absence(self, blood: Blood, frame: Frame) -> Absence:
        """Why this frame has no flow at the gate; nothing where it has."""
        lines = np.full(self._window.shape, self._line)
        return absence(blood, frame, self._window, lines, self.settings.wall_filter)

    def columns(
        self, blood: Blood, frame: Frame, moments: NDArray[np.float64]
    ) -> NDArray[np.uint8]:
        """Grey spectra (rows, K) at times (K,) s, the fastest towards the probe on top."""
        settings = self.settings
        means, which = blood.mean_velocities(frame, self._window)
        pulses = np.array([vessel.pulse(moments) for vessel in blood.vessels])
        velocities = means[None] * pulses[which].T  # where there is no vessel the mean is NaN
        power = np.empty((_ROWS, len(moments)))
        seeds = np.rint(moments * 1e6).astype(np.uint64)
        heard = 1.0 if frame.contact is None else float(frame.contact[0][self._line]) ** 2
        _fill_spectra(
            velocities, settings.nyquist_velocity, self._lowest, settings.wall_filter, heard,
            seeds, power,
        )  # fmt: skip
        level = 10.0 * np.log10(power) + settings.gain
        grey = 255.0 * (1.0 + level / settings.dynamic_range)
        return np.asarray(np.clip(grey, 0.0, 255.0).astype(np.uint8)[::-1])


def _gate_lines(
    middle: NDArray[np.float64],
    along: NDArray[np.float64],
    across: NDArray[np.float64],
    settings: SpectrumSettings,
    probe: Probe,
) -> list[NDArray[np.float64]]:
    """Lines (2, 2), column and row: the gate's ends, and the vessel's direction as it is set."""
    turn = settings.angle_correction
    vessel = math.cos(turn) * along + math.sin(turn) * across
    drawn = []
    for centre, direction, length in (
        (-0.5 * settings.size * along, across, _DRAWN),
        (0.5 * settings.size * along, across, _DRAWN),
        (np.zeros(2), vessel, 2.0 * _DRAWN if turn else 0.0),
    ):
        ends = centre + np.array([[-0.5], [0.5]]) * length * direction
        drawn += [middle + ends / probe.pixel_spacing] if length else []
    return drawn


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_spectra(velocities, nyquist, lowest, wall, heard, seeds, power):
    """Fills power (rows, K) from velocities (K, P), NaN outside blood; row 0 is ``lowest``.

    Args:
        heard: power of blood's echoes that the probe hears. seeds: (K,) of the noise.
    """
    rows = power.shape[0]
    per_row = 2.0 * nyquist / rows
    for k in range(len(velocities)):
        for r in range(rows):
            power[r, k] = 0.0
        places = velocities.shape[1]
        for p in range(places):
            v = np.float64(velocities[k, p])
            if np.isnan(v):
                continue
            sigma = nyquist * _LEAST_BROADENING + abs(v) * _TRANSIT
            middle = (v - lowest) / per_row - 0.5
            reach = np.int64(np.ceil(4.0 * sigma / per_row))
            first = np.int64(np.floor(middle)) - reach
            # The narrowest spectrum has power 1 where it is highest.
            height = heard * nyquist * _LEAST_BROADENING / sigma / places
            for r in range(first, first + 2 * reach + 2):
                apart = (r - middle) * per_row / sigma
                power[r % rows, k] += height * np.exp(-0.5 * apart * apart)
        for r in range(rows):
            seen = lowest + (r + 0.5) * per_row
            fast = (seen - 2.0 * nyquist * np.round(seen / (2.0 * nyquist))) ** 4
            passed = fast / (fast + wall**4) if fast > 0.0 else 0.0
            speckle = -np.log(uniform(seeds[k], np.uint64(r)))
            power[r, k] = (power[r, k] * passed + _NOISE) * speckle
