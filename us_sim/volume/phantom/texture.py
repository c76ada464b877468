"""Random textures of tissue: smooth noise, and the thin sheets where it is zero.

The noise is fixed by its seed and its lengths alone, so the same tissue comes out of every voxel
size.

>>> import numpy as np
>>> from us_sim.volume.phantom.texture import SmoothNoise
>>> block = np.array([[0.0, 0.0, 0.0], [0.02, 0.02, 0.02]])
>>> noise = SmoothNoise(np.random.Generator(np.random.PCG64(1)), block, (2e-3, 2e-3, 1e-3))
>>> noise.plane(np.linspace(0.0, 0.02, 50), 0.01, np.linspace(0.0, 0.02, 80)).shape
(50, 80)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_SPLINE_VARIANCE = 151.0 / 315.0
"""The mean over a cell of the sum of squared cubic B-spline weights: the variance that
interpolation leaves along an axis."""


class SmoothNoise:
    """Stationary noise of mean 0 and variance 1, twice continuously differentiable.

    A tensor product cubic B-spline with normally distributed coefficients.

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

    def plane(
        self, x: NDArray[np.float64], y: float, z: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """(X, Z) values at the coordinates x (X,), y and z (Z,), in m."""
        here = np.tensordot(self._weights(np.array([y]), 1)[0], self._coefficients, axes=(0, 1))
        return self._weights(x, 0) @ here @ self._weights(z, 2).T

    def line(self, x: NDArray[np.float64], y: float) -> NDArray[np.float64]:
        """(X,) values along x at y, m, in the lower face of the block."""
        return self.plane(x, y, self._lower[2:])[:, 0]

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


def sheets(
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
