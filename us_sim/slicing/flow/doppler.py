"""Colour and pulsed-wave Doppler: the velocity of blood as a scanner estimates it.

Colour Doppler (Kasai, Namekawa, Koyano, Omoto, IEEE Trans. Sonics Ultrason. 32, 1985): from pulse
to pulse the echo's phase turns by π v / n, for a velocity v along the beam and the Nyquist velocity
n. The turn is averaged over pulses and places as a complex number R, and arg R is shown, so faster
blood aliases. Here R comes of known velocities:

    R = w(v) exp(i π v / n), averaged over the resolution, plus noise,

with a wall filter w and complex normal noise. Part of the noise is proportional to R (spectral
broadening), part is the receiver's; both fall with the square root of the number of pulses.

Pulsed-wave Doppler: each column is the spectrum of one moment in the gate. The faster a velocity,
the more it is spread (transit time broadening), and the power in each bin is exponentially
distributed around its mean (J. A. Jensen, Estimation of Blood Velocities Using Ultrasound, 1996,
chapters 5 and 6).
"""

from __future__ import annotations

import math
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.errors import ProbeError
from us_sim.geometry.pose import Pose
from us_sim.kernels import njit
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.drawing.overlay import ColourScale
from us_sim.slicing.flow.blood import Blood, FlowAbsence, PixelWindow, explain_absence
from us_sim.slicing.flow.vessel import Vessel
from us_sim.slicing.frame import Frame
from us_sim.slicing.m_mode import SweepPicture
from us_sim.slicing.probe.beams import (
    compute_beam_angles,
    compute_beam_coordinates,
    convert_to_pixels,
    require_depth,
    require_steering,
)
from us_sim.slicing.probe.probe import LinearProbe, Probe
from us_sim.slicing.settings import ColourSettings, FlowSettings, SpectrumSettings
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
from us_sim.volume.volume import Volume

_STEP = np.uint64(0x9E3779B97F4A7C15)
_FIRST, _SECOND = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)


@njit(cache=True, nogil=True, error_model="numpy")
def draw_uniform(seed, place):
    """Draw a number above 0, and at most 1, from two of type uint64: the same in every run.

    By the finaliser of SplitMix64 (Steele, Lea, Flood, OOPSLA 2014).
    """
    x = (seed * _STEP) ^ (place + _STEP)
    for _ in range(2):
        x = (x ^ (x >> np.uint64(30))) * _FIRST
        x = (x ^ (x >> np.uint64(27))) * _SECOND
        x = (x ^ (x >> np.uint64(31))) + _STEP
    return (np.float64(x >> np.uint64(11)) + 1.0) * (1.0 / 9007199254740992.0)


@njit(cache=True, nogil=True, error_model="numpy")
def draw_normal_pair(seed, place):
    """Draw two independent normal numbers (G. E. P. Box, M. E. Muller, 1958)."""
    size = np.sqrt(-2.0 * np.log(draw_uniform(seed, place)))
    angle = 2.0 * np.pi * draw_uniform(seed ^ _SECOND, place)
    return size * np.cos(angle), size * np.sin(angle)


_SHOWN = 0.3  # size of R, over that of fast blood, from which colour is shown with a gain of 0 dB
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
        return convert_to_pixels(self._probe, fraction + self._lean(depth), depth)

    def compute_true_velocity(self, blood: Blood, frame: Frame) -> NDArray[np.float32]:
        """Return m/s along the box's beams towards the probe, at all pixels; NaN outside lumens."""
        return blood.compute_velocity(frame, self._whole)

    def estimate_velocity(self, blood: Blood, frame: Frame) -> NDArray[np.float32]:
        """Estimate m/s towards the probe (rows, columns); NaN where no colour is shown.

        Noise is a function of the frame's time and the place.
        """
        settings = self.settings
        turned = np.empty((*self._window.shape, 2), dtype=np.float32)
        velocity = blood.compute_velocity(frame, self._window)
        _fill_phasors(velocity, settings.nyquist_velocity, settings.wall_filter, turned)
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
        _fill_velocities(
            turned, noise, self._within, settings.nyquist_velocity,
            _SHOWN * 10.0 ** (-settings.gain / 20.0), _BROADENING * scale, _RECEIVER * scale,
            shown[row : row + rows, column : column + columns],
        )  # fmt: skip
        return shown

    def explain_absence(
        self, blood: Blood, frame: Frame, shown: NDArray[np.float32]
    ) -> FlowAbsence:
        """Explain why an estimate of this frame shows no colour; NOTHING where it does."""
        if np.count_nonzero(np.isfinite(shown)) > _COLOURED * self._within.sum():
            return FlowAbsence.NOTHING
        return explain_absence(blood, frame, self._window, self._lines, self.settings.wall_filter)

    @cached_property
    def _whole(self) -> PixelWindow:
        fraction, _ = compute_beam_coordinates(self._probe)
        return PixelWindow(
            self._probe, compute_beam_angles(self._probe, fraction, self.settings.steering)
        )

    def _lean(self, depth: NDArray[np.float64] | NDArray[np.float32]) -> NDArray[np.float64]:
        """Return the shift (fraction) of a steered beam from its place in the box's middle."""
        if not isinstance(self._probe, LinearProbe):
            return np.zeros_like(depth)
        slope = math.tan(self.settings.steering) / self._probe.aperture
        return np.asarray((depth - self._depth) * slope)

    def _lines_of(
        self, fraction: NDArray[np.float32], depth: NDArray[np.float32]
    ) -> NDArray[np.intp]:
        """Return the line at whose place on the face the steered beam of each pixel starts."""
        probe = self._probe
        start = np.nan_to_num(fraction)
        if isinstance(probe, LinearProbe):
            start = start - depth * math.tan(self.settings.steering) / probe.aperture
        return np.clip(np.rint((start + 0.5) * probe.lines - 0.5), 0, probe.lines - 1).astype(int)

    def _lay_out(self) -> None:
        fraction, depth = compute_beam_coordinates(self._probe)
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
        angles = compute_beam_angles(self._probe, fraction[box], self.settings.steering)
        self._window = PixelWindow(self._probe, angles, corner=self._corner)
        # Beyond the box nothing is computed, as no beams go there.
        self._window.pixel[~self._within.ravel()] = -1
        cell = self.settings.resolution / self._probe.pixel_spacing
        across, along = np.maximum(1, np.rint(cell)).astype(int).tolist()
        self._cell = across, along
        size = np.maximum(1.0, cell)[::-1]
        self._noise_shape = np.maximum(1, np.ceil(self._within.shape / size)).astype(int)


@njit(inline="always", error_model="numpy")
def _wall_filter_gain(v, nyquist, wall):
    """Return the part of a velocity's power that the wall filter, after aliasing, lets through."""
    fast = (v - 2.0 * nyquist * np.round(v / (2.0 * nyquist))) ** 4
    return fast / (fast + wall**4) if fast > 0.0 else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_phasors(velocity, nyquist, wall, turned):
    """Fill turned (rows, columns, 2): real and imaginary part of a place's R, without noise."""
    for row in range(velocity.shape[0]):
        for column in range(velocity.shape[1]):
            v = velocity[row, column]
            turned[row, column, 0] = turned[row, column, 1] = 0.0
            if not np.isnan(v):
                weight = _wall_filter_gain(v, nyquist, wall)
                angle = np.pi * v / nyquist
                turned[row, column, 0] = weight * np.cos(angle)
                turned[row, column, 1] = weight * np.sin(angle)


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_noise(seed, noise):
    """Fill noise (rows, columns, 2) with independent normal numbers of variance 1/2."""
    for row in range(noise.shape[0]):
        for column in range(noise.shape[1]):
            place = np.uint64(row) * np.uint64(65536) + np.uint64(column)
            one, other = draw_normal_pair(seed, place)
            noise[row, column, 0] = one * np.sqrt(0.5)
            noise[row, column, 1] = other * np.sqrt(0.5)


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_velocities(turned, noise, within, nyquist, least, broadening, receiver, shown):
    """Fill shown (rows, columns) with velocities where R with its noise is large enough."""
    for row in range(within.shape[0]):
        for column in range(within.shape[1]):
            if not within[row, column]:
                continue
            x, y = turned[row, column, 0], turned[row, column, 1]
            scale = broadening * np.sqrt(x * x + y * y) + receiver
            x += scale * noise[row, column, 0]
            y += scale * noise[row, column, 1]
            if x * x + y * y >= least * least:
                shown[row, column] = nyquist / np.pi * np.arctan2(y, x)


_ROWS, _COLUMNS = 256, 512
_ALONG, _ACROSS = 15, 7  # places in the gate along the beam and across it
_BEAM = 1e-3  # width of the gate across the beam, m: that of a beam of 5 to 8 MHz at its focus
_LEAST_BROADENING, _TRANSIT = 0.012, 0.06
"""Standard deviation of what one velocity is spread over: of the Nyquist velocity, and of the
velocity itself."""

_DRAWN = 3e-3  # length of the lines that show the gate, m
_NOISE = 1e-4
"""The receiver's power in a bin, over that of a gate full of blood of one slow velocity."""
_CLEAR = 4.0  # power of blood, over that of noise and black, from which it can be told from them


class Spectrum:
    """The spectrum at a gate of one probe's images.

    Raises:
        ProbeError: the gate is outside the image, or this probe cannot be steered.
    """

    def __init__(self, probe: Probe, settings: SpectrumSettings) -> None:
        self.settings = settings
        require_steering(probe, "spectrum.steering", settings.steering)
        depth = require_depth(probe, "spectrum.depth", settings.depth, "the gate")
        start = np.array([settings.lateral])
        middle = convert_to_pixels(probe, start, np.array([depth]), settings.steering)[0]
        if not (-0.5 <= middle[0] <= probe.columns - 0.5 and middle[1] <= probe.rows - 0.5):
            raise ProbeError("spectrum.steering: the gate lies beside the image: steer it less")
        angle = float(compute_beam_angles(probe, start, settings.steering)[0])
        along = np.array([math.sin(angle), math.cos(angle)])
        across = np.array([along[1], -along[0]])
        far = settings.size * ((np.arange(_ALONG) + 0.5) / _ALONG - 0.5)
        wide = _BEAM * ((np.arange(_ACROSS) + 0.5) / _ACROSS - 0.5)
        offsets = far[:, None, None] * along + wide[None, :, None] * across
        places = middle + offsets.reshape(-1, 2) / probe.pixel_spacing
        line = round((settings.lateral + 0.5) * probe.lines - 0.5)
        self._line = min(max(line, 0), probe.lines - 1)
        self._window = PixelWindow(probe, np.full(len(places), angle), places)
        self.lines = _gate_lines(middle, along, across, settings, probe)
        nyquist, cosine = settings.nyquist_velocity, math.cos(settings.angle_correction)
        self._lowest = nyquist * (settings.baseline - 1.0)
        shown = 100.0 * np.array([self._lowest + 2.0 * nyquist, self._lowest]) / cosine
        self._picture = SweepPicture(
            _ROWS, _COLUMNS, settings.sweep, (float(shown[0]), float(shown[1]), "cm/s")
        )
        self._seen = -math.inf  # s, time of the newest column in which blood is seen

    def take_over_picture(self, before: Spectrum) -> None:
        """Go on with the picture of a gate that looked elsewhere, if its scales are the same."""
        if before._picture.layout == self._picture.layout:
            self._picture, self._seen = before._picture, before._seen

    def draw_sweep(self, blood: Blood, frame: Frame) -> NDArray[np.uint8]:
        """Draw the picture (rows, columns, 3) up to the frame, with its scales.

        Between two frames the tissue is taken to be as in the later one; the pulse is not.
        """
        moments = self._picture.advance_to(frame.time)
        columns, seen = self.compute_columns(blood, frame, moments)
        self._picture.append_columns(columns)
        self._seen = moments[seen].max(initial=self._seen)
        return self._picture.draw_picture()

    def explain_absence(self, blood: Blood, frame: Frame) -> FlowAbsence:
        """Explain why the picture up to this frame shows no blood; NOTHING where it does."""
        if 0.0 <= frame.time - self._seen < self.settings.sweep:
            return FlowAbsence.NOTHING
        lines = np.full(self._window.shape, self._line)
        return explain_absence(blood, frame, self._window, lines, self.settings.wall_filter)

    def compute_columns(
        self, blood: Blood, frame: Frame, moments: NDArray[np.float64]
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Compute grey spectra (rows, K) at times (K,) s, the fastest towards the probe on top.

        Return with them (K,) True where blood is seen: brighter than black, and than the noise.
        """
        settings = self.settings
        means, which = blood.compute_mean_velocities(frame, self._window)
        pulses = np.array([vessel.evaluate_pulse(moments) for vessel in blood.vessels])
        velocities = means[None] * pulses[which].T  # where there is no vessel the mean is NaN
        power, peak = np.empty((_ROWS, len(moments))), np.empty(len(moments))
        seeds = np.rint(moments * 1e6).astype(np.uint64)
        heard = 1.0 if frame.contact is None else float(frame.contact[0][self._line]) ** 2
        _fill_spectra(
            velocities, settings.nyquist_velocity, self._lowest, settings.wall_filter, heard,
            seeds, power, peak,
        )  # fmt: skip
        black = 10.0 ** (-0.1 * (settings.dynamic_range + settings.gain))
        grey = 2550.0 / settings.dynamic_range * np.log10(power / black)
        return np.clip(grey, 0.0, 255.0).astype(np.uint8)[::-1], peak > _CLEAR * max(black, _NOISE)


def _gate_lines(
    middle: NDArray[np.float64],
    along: NDArray[np.float64],
    across: NDArray[np.float64],
    settings: SpectrumSettings,
    probe: Probe,
) -> list[NDArray[np.float64]]:
    """Return lines (2, 2), column and row: the gate's ends, and the vessel's direction as set."""
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
def _fill_spectra(velocities, nyquist, lowest, wall, heard, seeds, power, peak):
    """Fill power (rows, K) and peak (K,), its most without noise; row 0 is ``lowest``.

    Shapes and units:
        velocities: (K, P), NaN outside blood.
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
            height *= _wall_filter_gain(v, nyquist, wall)
            for r in range(first, first + 2 * reach + 2):
                apart = (r - middle) * per_row / sigma
                power[r % rows, k] += height * np.exp(-0.5 * apart * apart)
        peak[k] = 0.0
        for r in range(rows):
            speckle = -np.log(draw_uniform(seeds[k], np.uint64(r)))
            peak[k] = max(peak[k], power[r, k])
            power[r, k] = (power[r, k] + _NOISE) * speckle


_FOLLOWING_STEP = 6  # pixels from one place that is looked at to the next
_REACH = 8e-3  # m around the nearest place of a vessel, which may cross the image twice


def find_nearest_vessel(
    blood: Blood, frame: Frame, lateral: float, depth: float, steering: float = 0.0
) -> tuple[float, float] | None:
    """Find the centre in the image of the lumen nearest to a place; None without any.

    Args:
        blood: the vessels.
        frame: the image.
        lateral: of the place, fraction of the face as of `convert_to_pixels`.
        depth: of the place, m.
        steering: rad, of beams that lead to places.
    """
    probe = frame.probe
    columns, rows = (
        np.arange(0, probe.columns, _FOLLOWING_STEP),
        np.arange(0, probe.rows, _FOLLOWING_STEP),
    )
    grid: NDArray[np.float64] = np.stack(np.meshgrid(columns, rows), axis=-1).astype(float)
    window = PixelWindow(probe, np.zeros(grid.shape[:2]), grid)
    _, which = blood.compute_mean_velocities(frame, window)
    here = convert_to_pixels(probe, np.array([lateral]), np.array([depth]), steering)[0]
    far = np.linalg.norm((grid - here) * probe.pixel_spacing, axis=-1)
    far[which < 0] = np.inf
    if not np.isfinite(far).any():
        return None
    nearest = np.unravel_index(np.argmin(far), far.shape)
    beside = np.linalg.norm((grid - grid[nearest]) * probe.pixel_spacing, axis=-1) < _REACH
    column, row = np.rint(grid[beside & (which == which[nearest])].mean(axis=0)).astype(int)
    fractions, depths = compute_beam_coordinates(probe)
    across, down = float(fractions[row, column]), float(depths[row, column])
    if isinstance(probe, LinearProbe) and steering != 0.0:
        across -= down * math.tan(steering) / probe.aperture
        down /= math.cos(steering)
    return (across, down) if math.isfinite(across) else None


def warm_up() -> None:
    """Run every kernel of this room once, on a tube of a few voxels."""
    x, z = np.meshgrid(np.arange(9) - 4, np.arange(9) - 4, indexing="ij")
    tube = np.repeat((x**2 + z**2 < 10)[:, None], 40, axis=1).astype(np.uint8)
    volume = Volume(tube, np.diag([1e-3, 1e-3, 1e-3, 1.0]), tube, {1: "vessel"})
    flow = FlowSettings("arterial", (0.0, 1.0, 0.0), peak_velocity=0.5, mean_velocity=0.1)
    blood = Blood([Vessel("vessel", volume, 1, flow)])
    # Part of the tube lies outside.
    mesh = box_mesh([1e-3, 8e-3], [0.0, 0.02, 0.03], [0.0, 8e-3])
    probe = LinearProbe(aperture=8e-3, depth=8e-3, columns=8, rows=8)
    scanner = BMode(volume, probe)
    scanner.attach_mesh(mesh.nodes, mesh.tetrahedra)
    colour = ColourDoppler(probe, ColourSettings(width=1.0))
    spectrum = Spectrum(probe, SpectrumSettings())
    for nodes in (None, mesh.nodes):
        frame = scanner.make_frame(Pose(np.array([4e-3, 0.02, 0.0])), nodes, time=1.0)
        colour.estimate_velocity(blood, frame)
        spectrum.compute_columns(blood, frame, np.array([1.0]))
