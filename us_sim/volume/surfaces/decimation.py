"""Fewer triangles for a closed surface, within a distance from it that is measured.

Edges are collapsed by the quadric error of M. Garland and P. Heckbert, "Surface simplification
using quadric error metrics", SIGGRAPH 1997, in the library fast-simplification. That knows no
distance, so the fewest triangles whose distance is allowed are searched for.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import UsSimError, VolumeError
from us_sim.volume.surfaces.closed_surface import ClosedSurface
from us_sim.volume.surfaces.smoothing import with_volume
from us_sim.volume.surfaces.surface_distance import distances_to

_FEWEST = 0.02  # of the triangles
_TRIALS = 6
"""Each halves the logarithm of the range in which the answer lies."""

_SAMPLING = 2.0
"""Spacing of samples in sides of the smaller triangles."""

_CAREFUL = 3
"""How boldly fast-simplification collapses edges, 0 to 10; at 7, its
default, errors are ten times as large."""

_SAME_VOLUME = 0.01
"""Part of a surface's volume up to which one of fewer triangles may enclose more or less."""

_NO_GAIN = 0.9  # of the triangles; a surface that keeps more stays as it is


def decimated(surface: ClosedSurface, farthest: float) -> tuple[ClosedSurface, float]:
    """The same shape in fewer triangles: closed, with the same volume, parts and genus.

    Args:
        surface: closed.
        farthest: m, between the two surfaces.

    Returns:
        The surface, the one given where hardly a triangle can go; and the distance in m between the
        two, see `surface_distance`.

    Raises:
        VolumeError: fast-simplification is not installed.
    """
    best, distance = surface, 0.0
    low, high = np.log(_FEWEST), 0.0
    for _ in range(_TRIALS):
        middle = (low + high) / 2.0
        tried = _with_fraction(surface, float(np.exp(middle)))
        if tried is not None:
            tried = with_volume(tried, surface.volume, farthest)
        away = np.inf if tried is None else surface_distance(surface, tried)
        if tried is None or away > farthest:
            low = middle
            continue
        high = middle
        if len(tried.triangles) < len(best.triangles):
            best, distance = tried, away
    if len(best.triangles) > _NO_GAIN * len(surface.triangles):
        return surface, 0.0
    return best, distance


def coarsened(surface: ClosedSurface, triangles: int) -> ClosedSurface:
    """The same shape in about so many triangles: closed, with the same volume, parts and genus.

    It keeps more where fewer would change that.

    Args:
        surface: closed.
        triangles: that it should have.

    Raises:
        VolumeError: fast-simplification is not installed.
    """
    fraction = triangles / len(surface.triangles)
    while fraction < _NO_GAIN:
        tried = _with_fraction(surface, fraction)
        if tried is not None:
            farthest = float(np.sqrt(tried.area / len(tried.triangles)))
            tried = with_volume(tried, surface.volume, farthest)
            if not tried.fault and abs(tried.volume / surface.volume - 1.0) < _SAME_VOLUME:
                return tried
        fraction *= 2.0
    return surface


def surface_distance(one: ClosedSurface, other: ClosedSurface) -> float:
    """m, the largest distance from one to the other at their vertices and triangles' centres."""
    spacing = float(np.sqrt(min(s.area / len(s.triangles) for s in (one, other)))) * _SAMPLING
    return max(
        float(distances_to(_samples(a), b.vertices, b.triangles, spacing).max())
        for a, b in ((one, other), (other, one))
    )


def _samples(surface: ClosedSurface) -> NDArray[np.float64]:
    centres = surface.vertices[surface.triangles].mean(axis=1)
    return np.concatenate([surface.vertices, centres])


def _with_fraction(surface: ClosedSurface, fraction: float) -> ClosedSurface | None:
    """The surface with that fraction of its triangles; None where its topology would change."""
    try:
        from fast_simplification import simplify
    except ImportError as error:
        raise VolumeError(
            "fewer triangles need the library fast-simplification; install it with `pip install "
            "'us_sim[surfaces]'`, or ask for no decimation"
        ) from error
    # In units of its size, since the library works in single precision.
    middle = surface.vertices.mean(axis=0)
    size = float(np.ptp(surface.vertices, axis=0).max())
    points = ((surface.vertices - middle) / size).astype(np.float32)
    vertices, triangles = simplify(points, surface.triangles, 1.0 - fraction, agg=_CAREFUL)
    used, triangles = np.unique(triangles, return_inverse=True)
    try:
        made = ClosedSurface(
            vertices[used].astype(np.float64) * size + middle,
            triangles.reshape(-1, 3).astype(np.int32),
        )
    except UsSimError:
        return None
    alike = not made.fault and (made.parts, made.genus) == (surface.parts, surface.genus)
    return made if alike else None
