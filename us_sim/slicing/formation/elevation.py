"""The thickness of the beam: an image averages what lies in front of and behind its plane.

>>> from us_sim.slicing.formation.elevation import Elevation
>>> from us_sim.slicing.formation.imaging import Imaging
>>> from us_sim.slicing.probe.probe import LinearProbe
>>> probe = LinearProbe(aperture=0.04, depth=0.04, columns=64, rows=64)
>>> Elevation(probe, Imaging(elevation_planes=3, elevation_width=2e-3)).offsets * 1e3
array([-1.69..., 0. , 1.69...])
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from us_sim.kernels import njit
from us_sim.slicing.formation.imaging import Imaging
from us_sim.slicing.probe.beams import beam_width, depth_steps, focus_of, step_depths
from us_sim.slicing.probe.probe import Probe

WIDTH_PER_SIGMA = 2 * math.sqrt(2 * math.log(2))
"""Full width at half maximum of a Gaussian, in standard deviations."""

_WHOLE = 1 << 15  # the sum of the weights of a pixel, in fixed point


class Elevation:
    """Parallel slices and their weights, which follow the beam's hourglass in depth.

    At every depth the weights are a Gaussian's at the planes, its own width chosen such that
    their variance is exactly the beam's. So a few planes, a fixed distance apart, average a volume
    that is quadratic across the plane as the continuous beam does. (An even number has no plane in
    the middle and cannot be thinner than the innermost two are apart.) Grey values are averaged,
    as when images of neighbouring planes are compounded.
    """

    def __init__(self, probe: Probe, imaging: Imaging) -> None:
        count = imaging.elevation_planes
        depths = step_depths(probe)
        sigma = beam_width(depths, imaging.elevation_width, focus_of(probe)) / WIDTH_PER_SIGMA
        # The outer planes of binomial weights of this variance; those come near a Gaussian.
        reach = math.sqrt(count - 1) * float(sigma.max())
        self.offsets: NDArray[np.float64] = np.linspace(-reach, reach, count)  # m, along y
        self.weights = _matched_weights(self.offsets, sigma)  # (DEPTH_STEPS, planes)
        fixed = _fixed_point(self.weights)
        self._weights = np.ascontiguousarray(fixed.T)[:, depth_steps(probe)]

    def average(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
        """The weighted mean (rows, columns) of the images (rows, columns) on the planes."""
        total = np.full(images[0].size, _WHOLE // 2, dtype=np.uint32)
        for image, weights in zip(images, self._weights, strict=True):
            _add_weighted(image.reshape(-1), weights.reshape(-1), total)
        total >>= 15
        return total.astype(np.uint8).reshape(images[0].shape)


def _matched_weights(
    offsets: NDArray[np.float64], sigma: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(depths, planes) that sum to 1 and have the variance sigma² (depths,) about 0.

    Two planes have the variance of their distance, whatever their weights.
    """
    squares = offsets**2
    low, high = np.full(len(sigma), 1e-3), np.full(len(sigma), 30.0)  # of sigma
    for _ in range(40):
        middle = np.sqrt(low * high)
        weights = _gaussian(squares, middle * sigma)
        narrow = weights @ squares < sigma**2
        low, high = np.where(narrow, middle, low), np.where(narrow, high, middle)
    return _gaussian(squares, np.sqrt(low * high) * sigma)


def _gaussian(squares: NDArray[np.float64], sigma: NDArray[np.float64]) -> NDArray[np.float64]:
    exponent = -(squares - squares.min()) / (2 * sigma[:, None] ** 2)
    weights = np.exp(exponent)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


def _fixed_point(weights: NDArray[np.float64]) -> NDArray[np.uint16]:
    """The weights in fixed point, symmetric and with the exact sum: even tissue stays even."""
    half = weights.shape[1] // 2
    outer = np.round(weights[:, :half] * _WHOLE).astype(np.int64)
    if weights.shape[1] % 2:
        middle = _WHOLE - 2 * outer.sum(axis=1, keepdims=True)
        whole = np.concatenate([outer, middle, outer[:, ::-1]], axis=1)
    else:
        outer[:, -1] += _WHOLE // 2 - outer.sum(axis=1)
        whole = np.concatenate([outer, outer[:, ::-1]], axis=1)
    return whole.astype(np.uint16)


@njit(cache=True, nogil=True, error_model="numpy")
def _add_weighted(image, weights, total):
    for i in range(len(image)):
        total[i] += np.uint32(image[i]) * np.uint32(weights[i])
