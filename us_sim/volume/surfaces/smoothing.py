"""Smoothing of closed surfaces by a low-pass filter that does not shrink them.

The filter is the windowed sinc of G. Taubin, T. Zhang and G. Golub, "Optimal surface smoothing as
filter design", ECCV 1996: a polynomial of the surface's umbrella operator in Chebyshev's form. What
volume it still loses is given back by moving every vertex a little along its normal.

>>> import numpy as np
>>> from us_sim.volume.surfaces.smoothing import filter_coefficients, response
>>> coefficients = filter_coefficients(pass_band=0.1, degree=20)
>>> np.round(response(coefficients, np.array([0.0, 0.02, 1.0, 2.0])), 2) + 0.0  # eigenvalues
array([1.  , 0.95, 0.  , 0.  ])
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from us_sim.geometry.triangles import vertex_normals
from us_sim.volume.surfaces.closed_surface import ClosedSurface

_CORRECTIONS = 4
"""Newton steps to the wanted volume; each leaves the square of the error before."""

_EXACT = 1e-6  # of the volume

_WIDEST_BAND = 1.5

_SHARPNESS = 10.0
"""Degree of the filter times the square root of its pass band: with it, bumps twice as long as the
limit keep 0.98 of their height, and those half as long 0.01."""

_DEGREES = (8, 80)


def smoothed(surface: ClosedSurface, wavelength: float, spacing: float) -> ClosedSurface:
    """Take away bumps that are shorter than a wavelength; of those as long half is left.

    Args:
        surface: closed.
        wavelength: m.
        spacing: m, mean side of the voxels that the surface was made of.
    """
    pass_band = pass_band_for(wavelength, spacing)
    degree = int(np.clip(_SHARPNESS / np.sqrt(pass_band), *_DEGREES))
    coefficients = filter_coefficients(pass_band, degree)
    average = _averaging(surface)
    # With the operator 1 - average, whose eigenvalues k are 0 to 2, Chebyshev's argument is
    # 1 - k / 2 = (1 + average) / 2.
    middle = surface.vertices.mean(axis=0)
    before = surface.vertices - middle
    now = 0.5 * (before + average @ before)
    result = coefficients[0] * before + coefficients[1] * now
    for coefficient in coefficients[2:]:
        before, now = now, now + average @ now - before
        result += coefficient * now
    return surface.moved_to(result + middle)


def with_volume(surface: ClosedSurface, volume: float, farthest: float) -> ClosedSurface:
    """Move all vertices alike along their normals until the surface encloses a volume.

    Args:
        surface: closed, facing outwards.
        volume: m³.
        farthest: m; no vertex is moved farther, so a surface may stop short of the volume.
    """
    normals = vertex_normals(surface.vertices, surface.triangles)
    moved, distance = surface, 0.0
    for _ in range(_CORRECTIONS):
        missing = volume - moved.volume
        if abs(missing) <= _EXACT * volume:
            break
        distance += missing / moved.area
        distance = float(np.clip(distance, -farthest, farthest))
        moved = surface.moved_to(surface.vertices + distance * normals)
    return moved


def pass_band_for(wavelength: float, spacing: float) -> float:
    """The eigenvalue of the umbrella operator that a wavelength has on a mesh of voxels.

    On a regular mesh with edges h the operator is -h²/4 times Laplace's, so that a wavelength L has
    the eigenvalue (π h / L)². Marching cubes makes edges of 0.85 voxels on average.
    """
    return float(min((np.pi * 0.85 * spacing / wavelength) ** 2, _WIDEST_BAND))


def filter_coefficients(pass_band: float, degree: int) -> NDArray[np.float64]:
    """(degree + 1,) coefficients of Chebyshev polynomials in 1 - k / 2 (Taubin 1996, section 4).

    They are those of an ideal low-pass filter, times a Hamming window, and made to sum to one so
    that what does not vary stays.

    Args:
        pass_band: the eigenvalue k, 0 to 2, at which the filter lets half through.
        degree: of the polynomial.
    """
    angle = np.arccos(1.0 - pass_band / 2.0)
    n = np.arange(1, degree + 1)
    window = 0.54 + 0.46 * np.cos(n * np.pi / (degree + 1))
    ideal = 2.0 * np.sin(n * angle) / (n * np.pi)
    coefficients = np.concatenate([[angle / np.pi], window * ideal])
    return np.asarray(coefficients / coefficients.sum())


def response(
    coefficients: NDArray[np.float64], eigenvalues: NDArray[np.float64]
) -> NDArray[np.float64]:
    """How much of a bump with that eigenvalue of the umbrella operator the filter leaves."""
    return np.asarray(np.polynomial.chebyshev.chebval(1.0 - eigenvalues / 2.0, coefficients))


def _averaging(surface: ClosedSurface) -> csr_array:
    """(V, V) whose product with vertices is the mean of each one's neighbours.

    In a closed surface every edge has two triangles that run along it in opposite directions, so
    the triangles' directed edges name every neighbour once.
    """
    starts = surface.triangles.T.ravel()
    ends = np.roll(surface.triangles, -1, axis=1).T.ravel()
    count = len(surface.vertices)
    weights = 1.0 / np.maximum(np.bincount(starts, minlength=count), 1)
    return csr_array((weights[starts], (starts, ends)), shape=(count, count))
