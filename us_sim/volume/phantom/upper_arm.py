"""A virtual upper arm: its structures and textures, and the speckle of their echoes.

A block of the inner side of the arm, the skin at z = 0, vessels and humerus along y. Proportions
follow ultrasound images of the mid-arm: the brachial artery between a vein and the median nerve, in
a sheath under the fascia, biceps above and brachialis below, the humerus to one side. Sheets of
connective tissue within fat and muscle lie along the skin for the most part, so those that do are
the stronger ones. Loss, shadows, borders of structures and noise are `us_sim.slicing.acoustics`.

Each voxel holds a complex, normally distributed echo: the sum of many scatterers of random phase.
A Gaussian point spread correlates neighbours, and the envelope of the sum is Rayleigh distributed
wherever the mean echo is even (Wagner, Smith, Sandrik, Lopez 1983). Interfaces that are smooth on
the scale of a wavelength add an echo of one phase, which does not speckle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d, gaussian_filter1d

_SIGMA_PER_WIDTH = 1 / (2 * math.sqrt(2 * math.log(2)))
_REACH = 3.0  # standard deviations after which the point spread counts as 0


@dataclass(frozen=True)
class PointSpread:
    """Full widths at half maximum of a linear array's echo, m.

    Lateral and elevational width grow on both sides of their focus as those of a Gaussian beam,
    width · √(1 + (Δz / range)²).
    """

    axial: float = 0.40e-3
    lateral: float = 0.65e-3
    elevational: float = 1.3e-3
    focus: float = 18e-3  # depth
    lateral_range: float = 25e-3  # depth from the focus at which the width is √2 times as large
    elevational_range: float = 20e-3

    def compute_widths(self, depth: float) -> tuple[float, float]:
        """Return the lateral and elevational full width at half maximum at a depth, m."""
        away = depth - self.focus
        return (
            self.lateral * math.hypot(1.0, away / self.lateral_range),
            self.elevational * math.hypot(1.0, away / self.elevational_range),
        )

    def compute_reach(self, depth: NDArray[np.float64]) -> tuple[float, float, float]:
        """Return how far (x, y, z) m an echo spreads at any of the depths."""
        lateral, elevational = np.max([self.compute_widths(float(d)) for d in depth], axis=0)
        scale = _REACH * _SIGMA_PER_WIDTH
        return scale * float(lateral), scale * float(elevational), scale * self.axial


def compute_envelope(
    diffuse: NDArray[np.float32],
    specular: NDArray[np.float32],
    voxel_size: float,
    depth: NDArray[np.float64],
    point_spread: PointSpread,
    random: np.random.Generator,
) -> NDArray[np.float32]:
    """Return the envelope (i, j, k) of the echoes, seen by a beam along the last axis.

    Args:
        diffuse: (i, j, k) root mean square echo of the unresolved scatterers.
        specular: (i, j, k) echo of one phase, of smooth interfaces.
        voxel_size: m.
        depth: (k,) m, of each plane of voxels.
        point_spread: the image of one scatterer; voxels within its reach of the outer faces see
            fewer scatterers, so pass a block larger by that reach and crop.
        random: source of the scatterers.
    """
    square = np.zeros(diffuse.shape, dtype=np.float32)
    for phase in ("in phase", "quadrature"):
        echo = random.standard_normal(diffuse.shape, dtype=np.float32)
        echo *= diffuse
        echo *= np.float32(math.sqrt(0.5))
        _spread(echo, voxel_size, depth, point_spread, random_phase=True)
        if phase == "in phase":
            smooth = specular.astype(np.float32, copy=True)
            _spread(smooth, voxel_size, depth, point_spread, random_phase=False)
            echo += smooth
        echo *= echo
        square += echo
    return np.sqrt(square, out=square)


def log_compress(envelope: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return an envelope as grey values: 255 at 1 and above, 0 at 60 dB below it."""
    grey = np.maximum(envelope, np.float32(1e-6))
    np.log10(grey, out=grey)
    grey *= np.float32(20.0 * 255.0 / 60.0)
    grey += np.float32(255.5)
    return np.clip(grey, 0.0, 255.0, out=grey).astype(np.uint8)


def _spread(
    echo: NDArray[np.float32],
    voxel_size: float,
    depth: NDArray[np.float64],
    point_spread: PointSpread,
    *,
    random_phase: bool,
) -> None:
    """Convolve in place with the point spread, depth by depth."""
    axial = _profile(point_spread.axial, voxel_size, random_phase)
    correlate1d(echo, axial, axis=2, output=echo, mode="constant")
    for k, at in enumerate(depth):
        lateral, elevational = (
            _profile(width, voxel_size, random_phase)
            for width in point_spread.compute_widths(float(at))
        )
        plane = correlate1d(echo[:, :, k], lateral, axis=0, mode="constant")
        echo[:, :, k] = correlate1d(plane, elevational, axis=1, mode="constant")


def _profile(width: float, voxel_size: float, random_phase: bool) -> NDArray[np.float64]:
    """Gaussian weights that keep the power of random echoes, or the height of a wide even one."""
    sigma = width * _SIGMA_PER_WIDTH / voxel_size
    half = math.ceil(_REACH * sigma)
    weights = np.exp(-0.5 * (np.arange(-half, half + 1) / sigma) ** 2)
    return weights / (np.linalg.norm(weights) if random_phase else weights.sum())


@dataclass(frozen=True)
class Tube:
    """Centre line and cross-section, m, in a frame whose y runs along the tube."""

    centre: tuple[float, float]  # m, x and z
    radii: tuple[float, float]  # m, along x and z
    swing: tuple[float, float] = (0.0, 0.0)  # m, amplitude along x and z
    phase: float = 0.0  # rad, of the swing at y = 0

    def compute_centre(self, y: float) -> tuple[float, float]:
        """(x, z) m of the centre line at y."""
        angle = 2 * np.pi * y / 70e-3 + self.phase
        return (
            self.centre[0] + self.swing[0] * float(np.sin(angle)),
            self.centre[1] + self.swing[1] * float(np.sin(0.7 * angle + 1.0)),
        )

    def compute_distances(
        self, x: NDArray[np.float64], y: float, z: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Distance (X, Z) m from the wall, negative inside.

        The distance is exact on the wall and right to first order beside it.
        """
        middle_x, middle_z = self.compute_centre(y)
        across = (x[:, None] - middle_x) / self.radii[0]
        down = (z[None, :] - middle_z) / self.radii[1]
        # A square root is several times faster than hypot, and nothing here over- or underflows.
        radius = np.sqrt(np.maximum(across**2 + down**2, 1e-12))
        slope = np.sqrt((across / self.radii[0]) ** 2 + (down / self.radii[1]) ** 2)
        slope = np.maximum(slope, 1e-6 / max(self.radii))
        return np.asarray((radius - 1.0) * radius / slope)


_SPLINE_VARIANCE = 151.0 / 315.0
"""The variance that interpolation leaves along an axis: the mean over a cell of the sum of squared
cubic B-spline weights."""


class SmoothNoise:
    """Stationary noise of mean 0 and variance 1, twice continuously differentiable.

    A tensor product cubic B-spline with normally distributed coefficients, which its seed and its
    lengths alone decide, so the same tissue comes out of every voxel size.

    Args:
        random: source of the coefficients.
        block: (2, 3) m, lower and upper corner of the block to be sampled; the outermost
            coefficients continue beyond it.
        lengths: (x, y, z) m, between coefficients: features are about twice as long.
    """

    def __init__(
        self,
        random: np.random.Generator,
        block: NDArray[np.float64],
        lengths: tuple[float, float, float],
    ) -> None:
        self._lower = block[0]
        self._lengths = np.array(lengths)
        counts = np.ceil((block[1] - block[0]) / self._lengths - 1e-9).astype(int) + 3
        self._coefficients = random.standard_normal(counts) / _SPLINE_VARIANCE**1.5

    def sample_plane(
        self, x: NDArray[np.float64], y: float, z: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """(X, Z) values at the coordinates x (X,), y and z (Z,), in m."""
        here = np.tensordot(self._weights(np.array([y]), 1)[0], self._coefficients, axes=(0, 1))
        return self._weights(x, 0) @ here @ self._weights(z, 2).T

    def sample_line(self, x: NDArray[np.float64], y: float) -> NDArray[np.float64]:
        """(X,) values along x at y, m, in the lower face of the block."""
        return self.sample_plane(x, y, self._lower[2:])[:, 0]

    def _weights(self, values: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
        """(V, coefficients) cubic B-spline weights of positions along an axis."""
        count = self._coefficients.shape[axis]
        position = (values - self._lower[axis]) / self._lengths[axis]
        position = np.clip(position, 0.0, count - 3 - 1e-9)
        cell = np.floor(position).astype(int)
        t = position - cell
        weights = np.zeros((len(values), count))
        rows = np.arange(len(values))
        weights[rows, cell] = (1 - t) ** 3 / 6
        weights[rows, cell + 1] = (3 * t**3 - 6 * t**2 + 4) / 6
        weights[rows, cell + 2] = (-3 * t**3 + 3 * t**2 + 3 * t + 1) / 6
        weights[rows, cell + 3] = t**3 / 6
        return weights


def make_sheets(
    noise: NDArray[np.float64], steps: tuple[float, float], thickness: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Thin sheets of one thickness where a noise is zero: septa of fat, perimysium of muscle.

    Args:
        noise: (X, Z) a plane of smooth noise.
        steps: m, between its samples along x and z.
        thickness: m, the standard deviation of a sheet's profile.

    Returns:
        The profile (X, Z), 1 in a sheet's middle, and how squarely (X, Z) the sheet faces the
        beam along z: the squared cosine of the angle between its normal and z.
    """
    slope_x, slope_z = np.gradient(noise, *steps)
    # Where the noise is flat at zero the sheet would be a blot: bound the slope from below.
    square = slope_x**2 + slope_z**2
    square = np.maximum(square, 0.05 * square.mean())
    return np.exp(-(noise**2) / square / (2 * thickness**2)), slope_z**2 / square


UPPER_ARM_BLOCK = np.array([[-36e-3, -30e-3, 0.0], [36e-3, 30e-3, 54e-3]])
"""Lower and upper corner of the block in frame ``patient``, m."""

_MARGIN = np.array([[-5e-3], [5e-3]])
"""Texture continues this far beyond the block, m: echoes at its edges come from there too."""

UPPER_ARM_LABELS = {"skin": 1, "fat": 2, "muscle": 3, "bone": 4, "artery": 5, "vein": 6, "nerve": 7}
THROMBUS = {"vein thrombus": 8}

_SIDE_LOBES = -27.0  # dB
_BLOOD = -60.0  # dB, all but free of echoes
_SMOOTH = 0.7  # of an interface


class ArmSection:
    """A cross-section of the arm at one y (m), on evenly spaced x (X,) and z (Z,) m."""

    def __init__(self, x: NDArray[np.float64], y: float, z: NDArray[np.float64]) -> None:
        self.x, self.y, self.z = x, y, z
        self.labels = np.zeros((len(x), len(z)), dtype=np.uint8)
        self.diffuse = np.zeros((len(x), len(z)))  # rms echo of unresolved scatterers
        self.specular = np.zeros((len(x), len(z)))  # echo of smooth interfaces

    @property
    def steps(self) -> tuple[float, float]:
        """Distance between samples along x and z, m."""
        return float(self.x[1] - self.x[0]), float(self.z[1] - self.z[0])

    @property
    def depth(self) -> NDArray[np.float64]:
        """(Z,) m below the skin; 0 above it."""
        return np.maximum(self.z, 0.0)

    def fill_tissue(self, label: str, where: NDArray[np.bool_], echo: NDArray[np.float64]) -> None:
        """Put a tissue with its own scatterers where another was."""
        self.labels[where] = (UPPER_ARM_LABELS | THROMBUS)[label]
        self.diffuse[where] = echo[where]
        self.specular[where] = 0.0

    def add_interface(self, profile: NDArray[np.float64], level: float) -> None:
        """Add an echoing surface: a fraction of `_SMOOTH` is specular, the rest speckled."""
        np.maximum(self.specular, _SMOOTH * _echo(level) * profile, out=self.specular)
        np.maximum(self.diffuse, (1 - _SMOOTH) * _echo(level) * profile, out=self.diffuse)


class UpperArm:
    """An arm from a seed: it moves structures by half a millimetre and redraws every texture.

    Args:
        thrombus: from and to, m along y, where one fills the vein; one without a length is none.
    """

    def __init__(self, seed: int, thrombus: tuple[float, float] | None = None) -> None:
        self.labels = UPPER_ARM_LABELS | ({} if thrombus is None else THROMBUS)
        self._thrombus = thrombus or (0.0, 0.0)
        random = np.random.Generator(np.random.PCG64(seed))

        def tube(x: float, z: float, radius_x: float, radius_z: float, swing: float) -> Tube:
            shift_x, shift_z, size = random.uniform(-1.0, 1.0, 3) * (0.4e-3, 0.4e-3, 0.04)
            radii = radius_x * (1 + size), radius_z * (1 + size)
            return Tube((x + shift_x, z + shift_z), radii, (swing, 0.5 * swing), sway)

        def noise(*lengths: float) -> SmoothNoise:
            x, y, z = lengths
            return SmoothNoise(random, UPPER_ARM_BLOCK + _MARGIN, (x, y, z))

        # Bound in one sheath, vessels and nerve swing together.
        sway = random.uniform(0.0, 2 * np.pi)
        self.artery = tube(-6e-3, 15e-3, 2.25e-3, 2.25e-3, 0.8e-3)
        self.vein = tube(2e-3, 13e-3, 3.5e-3, 2.75e-3, 0.8e-3)
        self.nerve = tube(-11.2e-3, 13.4e-3, 2.4e-3, 1.9e-3, 0.8e-3)
        self.humerus = tube(12e-3, 38e-3, 10.5e-3, 9.8e-3, 0.3e-3)
        turn = random.uniform(0.0, 2 * np.pi)
        self._fascicles = [(0.0, 0.0)] + [
            (0.62 * np.cos(turn + angle), 0.62 * np.sin(turn + angle))
            for angle in np.arange(6) * np.pi / 3
        ]
        self._skin_border = noise(4e-3, 4e-3, 1.0)
        self._fascia_shape = noise(9e-3, 14e-3, 1.0)
        self._septum_shape = noise(8e-3, 20e-3, 1.0)
        self._lobules = noise(3.2e-3, 4.5e-3, 0.75e-3)
        self._fibres = noise(2.2e-3, 16e-3, 0.62e-3)
        self._bundles = noise(4.5e-3, 22e-3, 1.6e-3)
        self._patches = noise(3e-3, 6e-3, 1.6e-3)
        self._cloud = noise(6e-3, 9e-3, 4e-3)

    def cut_section(self, x: NDArray[np.float64], y: float, z: NDArray[np.float64]) -> ArmSection:
        """Labels and echoes at evenly spaced x (X,) and z (Z,), m.

        Points beside the block continue its tissue, those above it the skin.
        """
        section = ArmSection(x, y, z)
        self._layers(section)
        self._muscles(section)
        self._bundle(section)
        self._bone(section)
        _add_side_lobes(section)
        return section

    def _layers(self, section: ArmSection) -> None:
        """Add fat with its septa, and the skin over it."""
        x, y, z = section.x, section.y, section.depth
        border = 1.8e-3 + 0.08e-3 * self._skin_border.sample_line(x, y)[:, None]
        below = z[None, :] - border
        cloud = self._cloud.sample_plane(x, y, z)
        section.fill_tissue("fat", below >= 0.0, _echo(-37.0 + 1.5 * cloud))
        profile, facing = make_sheets(self._lobules.sample_plane(x, y, z), section.steps, 0.15e-3)
        section.add_interface(profile * self._patchy(section) * (0.1 + 0.9 * facing), -11.0)
        section.fill_tissue("skin", below < 0.0, _echo(-25.0 - 2800.0 * below + cloud))
        section.add_interface(_sheet(z[None, :] - 0.15e-3, 0.15e-3), -5.0)

    def _muscles(self, section: ArmSection) -> None:
        """Add biceps, brachialis and triceps under the fascia, with the septa between them."""
        x, y, z = section.x, section.y, section.depth
        fascia = 7.0e-3 + 0.6e-3 * self._fascia_shape.sample_line(x, y)[:, None]
        # Septa wave along the arm, and from place to place between the muscles they part.
        wave = self._septum_shape.sample_line(x, y)[:, None]
        wave = wave + 0.8 * self._cloud.sample_plane(x, y, z)
        # The medial septum runs from the fascia beside the nerve down to the humerus.
        left_of_septum = 0.9 * (-9e-3 + 0.42 * (z - 15e-3) + 0.5e-3 * wave - x[:, None])
        under_biceps = z - 21e-3 - 0.15 * x[:, None] - 0.8e-3 * wave
        triceps = left_of_septum > 0.0
        brachialis = ~triceps & (under_biceps > 0.0)
        patchy = self._patchy(section)
        # Fibres run along y, at each muscle's own small angle to the skin.
        for slope, gain, where in (
            (0.06, 0.0, ~triceps & ~brachialis),
            (-0.09, 1.5, brachialis),
            (0.13, -1.0, triceps),
        ):
            shifted = z + slope * y
            muscle = where & (z > fascia)
            cloud = self._cloud.sample_plane(x, y, shifted)
            section.fill_tissue("muscle", muscle, _echo(-41.0 + gain + 1.5 * cloud))
            for fibres, thickness, level in (
                (self._fibres, 0.12e-3, -18.0),
                (self._bundles, 0.17e-3, -13.0),
            ):
                profile, facing = make_sheets(
                    fibres.sample_plane(x, y, shifted), section.steps, thickness
                )
                profile *= patchy * (0.1 + 0.9 * facing) * muscle
                section.add_interface(profile, level + gain)
        section.add_interface(_sheet(z - fascia - 0.7e-3, 0.12e-3) * patchy, -16.0)
        section.add_interface(_sheet(left_of_septum, 0.2e-3) * (z > 13e-3) * patchy, -18.0)
        section.add_interface(_sheet(under_biceps, 0.2e-3) * ~triceps * (0.4 + 0.6 * patchy), -13.0)

    def _bundle(self, section: ArmSection) -> None:
        """Add artery, vein and nerve in bright connective tissue."""
        x, y, z = section.x, section.y, section.depth
        walls = [tube.compute_distances(x, y, z) for tube in (self.artery, self.vein, self.nerve)]
        near = np.maximum(np.min(walls, axis=0), 0.0)
        sheath = _echo(-31.0 + 2.0 * self._cloud.sample_plane(x, y, z)) * _sheet(near, 1.0e-3)
        np.maximum(section.diffuse, sheath, out=section.diffuse)
        for label, distance in zip(("artery", "vein"), walls, strict=False):
            section.fill_tissue(label, distance < 0.0, np.full(distance.shape, _echo(_BLOOD)))
        if self._thrombus[0] < y < self._thrombus[1]:
            clot = _echo(-39.0 + 3.0 * self._cloud.sample_plane(x, y, z))
            section.fill_tissue("vein thrombus", walls[1] < 0.0, clot)
        self._nerve(section, walls[2])

    def _nerve(self, section: ArmSection, distance: NDArray[np.float64]) -> None:
        """Add a nerve: dark fascicles in a bright honeycomb."""
        section.fill_tissue("nerve", distance < 0.0, np.full(distance.shape, _echo(-23.0)))
        middle_x, middle_z = self.nerve.compute_centre(section.y)
        radius_x, radius_z = self.nerve.radii
        for across, down in self._fascicles:
            squares_x = ((section.x - middle_x - across * radius_x) / 0.50e-3) ** 2
            squares_z = ((section.depth - middle_z - down * radius_z) / 0.42e-3) ** 2
            section.diffuse[squares_x[:, None] + squares_z < 1.0] = _echo(-48.0)

    def _bone(self, section: ArmSection) -> None:
        x, y, z = section.x, section.y, section.depth
        distance = self.humerus.compute_distances(x, y, z)
        distance -= 0.35e-3 * self._cloud.sample_plane(x, y, z)  # no shaft is an ellipse
        section.fill_tissue("bone", distance < 0.0, np.full(distance.shape, _echo(-42.0)))

    def _patchy(self, section: ArmSection) -> NDArray[np.float64]:
        """(X, Z) from 0 to 1: no sheet of connective tissue echoes everywhere."""
        noise = self._patches.sample_plane(section.x, section.y, section.depth)
        return np.clip(0.55 + 0.5 * noise, 0.0, 1.0)


def _add_side_lobes(section: ArmSection) -> None:
    """Add the echoes of the surroundings that side lobes receive, in lumens too."""
    step_x, step_z = section.steps
    power = gaussian_filter1d(section.diffuse**2 + section.specular**2, 2.5e-3 / step_x, axis=0)
    power = gaussian_filter1d(power, 0.5e-3 / step_z, axis=1)
    section.diffuse[:] = np.sqrt(section.diffuse**2 + _echo(_SIDE_LOBES) ** 2 * power)


def _echo(level: Any) -> Any:
    """Return the amplitude of a level in dB below full display."""
    return 10.0 ** (level / 20.0)


def _sheet(distance: NDArray[np.float64], thickness: float) -> NDArray[np.float64]:
    """Return the profile of a thin surface, 1 in its middle; thickness: standard deviation, m."""
    return np.exp(-0.5 * (distance / thickness) ** 2)
