"""Speckle: the envelope of the echoes of many unresolved scatterers, and its display.

Each voxel holds a complex, normally distributed echo: the sum of many scatterers of random phase.
A Gaussian point spread correlates neighbours, and the envelope of the sum is Rayleigh distributed
wherever the mean echo is even (Wagner, Smith, Sandrik, Lopez 1983). Interfaces that are smooth on
the scale of a wavelength add an echo of one phase, which does not speckle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d

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

    def widths(self, depth: float) -> tuple[float, float]:
        """Lateral and elevational full width at half maximum at a depth, m."""
        away = depth - self.focus
        return (
            self.lateral * math.hypot(1.0, away / self.lateral_range),
            self.elevational * math.hypot(1.0, away / self.elevational_range),
        )

    def reach(self, depth: NDArray[np.float64]) -> tuple[float, float, float]:
        """How far (x, y, z) m an echo spreads at any of the depths."""
        lateral, elevational = np.max([self.widths(float(d)) for d in depth], axis=0)
        scale = _REACH * _SIGMA_PER_WIDTH
        return scale * float(lateral), scale * float(elevational), scale * self.axial


def echo_envelope(
    diffuse: NDArray[np.float32],
    specular: NDArray[np.float32],
    voxel_size: float,
    depth: NDArray[np.float64],
    point_spread: PointSpread,
    random: np.random.Generator,
) -> NDArray[np.float32]:
    """The envelope (i, j, k) of the echoes, seen by a beam along the last axis.

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


def log_compress(envelope: NDArray[np.float32], dynamic_range: float = 60.0) -> NDArray[np.uint8]:
    """The envelope as grey values: 255 at 1 or more, 0 at ``dynamic_range`` dB below it or less."""
    grey = np.maximum(envelope, np.float32(1e-6))
    np.log10(grey, out=grey)
    grey *= np.float32(20.0 * 255.0 / dynamic_range)
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
            _profile(width, voxel_size, random_phase) for width in point_spread.widths(float(at))
        )
        plane = correlate1d(echo[:, :, k], lateral, axis=0, mode="constant")
        echo[:, :, k] = correlate1d(plane, elevational, axis=1, mode="constant")


def _profile(width: float, voxel_size: float, random_phase: bool) -> NDArray[np.float64]:
    """Gaussian weights that keep the power of random echoes, or the height of a wide even one."""
    sigma = width * _SIGMA_PER_WIDTH / voxel_size
    half = math.ceil(_REACH * sigma)
    weights = np.exp(-0.5 * (np.arange(-half, half + 1) / sigma) ** 2)
    return weights / (np.linalg.norm(weights) if random_phase else weights.sum())
