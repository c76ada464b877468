"""The surface of a labelled structure: drawn, smoothed with its volume kept, and coarsened.

Smoothing is the windowed sinc filter of G. Taubin, T. Zhang and G. Golub, "Optimal surface
smoothing as filter design", ECCV 1996: a polynomial of the surface's umbrella operator in
Chebyshev's form, which does not shrink as Laplace's does. The volume that it still loses is given
back by moving every vertex a little along its normal.

Edges are collapsed by the quadric error of M. Garland and P. Heckbert, "Surface simplification
using quadric error metrics", SIGGRAPH 1997, in the library fast-simplification.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from us_sim.errors import VolumeError
from us_sim.geometry.triangles import vertex_normals
from us_sim.volume.surfaces.closed_surface import ClosedSurface
from us_sim.volume.surfaces.label_surface import voxel_surface
from us_sim.volume.surfaces.settings import SurfaceSettings
from us_sim.volume.volume import Volume

_NO_GAIN = 0.9  # of the triangles; a surface that would keep more stays as it is


@dataclass(frozen=True, eq=False)
class StructureSurface:
    """The surface of a structure."""

    name: str
    surface: ClosedSurface
    voxels_volume: float  # m³, of the label's voxels

    @property
    def volume_kept(self) -> float:
        """The volume inside over that of the label's voxels."""
        return self.surface.volume / self.voxels_volume


def structure_surface(
    volume: Volume, label: int, settings: SurfaceSettings | None = None
) -> StructureSurface:
    """Draw the closed surface around a label, facing outwards, with the volume of its voxels.

    Raises:
        VolumeError: the label does not occur, its surface is not closed, or a library is missing.
    """
    settings = settings or SurfaceSettings()
    name = volume.label_names.get(label, f"label {label}")
    surface, inside = voxel_surface(volume, label)
    spacing = float(np.linalg.norm(volume.index_to_patient[:3, :3], axis=0).mean())
    # The stairs of a surface that lies aslant are six voxels long at most nearly everywhere.
    wavelength = 6.0 * spacing if settings.smoothing is None else settings.smoothing
    if wavelength > 0.0:
        surface = smoothed(surface, wavelength, spacing)
    surface = with_volume(surface, inside, 0.5 * spacing)
    if settings.decimation > 0.0:
        surface = coarsened(surface, round((1.0 - settings.decimation) * len(surface.triangles)))
    if surface.fault:
        raise VolumeError(f"the surface of {name} is not closed: {surface.fault}")
    return StructureSurface(name, surface, inside)


def smoothed(surface: ClosedSurface, wavelength: float, spacing: float) -> ClosedSurface:
    """Take away bumps that are shorter than a wavelength; of those as long half is left.

    Args:
        surface: closed.
        wavelength: m.
        spacing: m, mean side of the voxels that the surface was made of.
    """
    # On a regular mesh with edges h the umbrella operator is -h²/4 times Laplace's, so that a
    # wavelength L has the eigenvalue (π h / L)². Marching cubes makes edges of 0.85 voxels.
    pass_band = float(min((np.pi * 0.85 * spacing / wavelength) ** 2, 1.5))
    # With this degree bumps twice as long keep 0.98 of their height, and those half as long 0.01.
    degree = int(np.clip(10.0 / np.sqrt(pass_band), 8, 80))
    # An ideal low-pass filter in Chebyshev polynomials times a Hamming window; a constant stays.
    angle, n = np.arccos(1.0 - pass_band / 2.0), np.arange(1, degree + 1)
    window = 0.54 + 0.46 * np.cos(n * np.pi / (degree + 1))
    coefficients = np.array([angle / np.pi, *(window * 2.0 * np.sin(n * angle) / (n * np.pi))])
    coefficients /= coefficients.sum()
    # In a closed surface the triangles' directed edges name every neighbour of a vertex once.
    starts, ends = surface.half_edges
    count = len(surface.vertices)
    weights = 1.0 / np.maximum(np.bincount(starts, minlength=count), 1)
    average = csr_array((weights[starts], (starts, ends)), shape=(count, count))
    # With the operator 1 - average, whose eigenvalues k are 0 to 2, Chebyshev's argument is
    # 1 - k / 2 = (1 + average) / 2.
    middle = surface.vertices.mean(axis=0)
    before = surface.vertices - middle
    now = 0.5 * (before + average @ before)
    result = coefficients[0] * before + coefficients[1] * now
    for coefficient in coefficients[2:]:
        before, now = now, now + average @ now - before
        result += coefficient * now
    return ClosedSurface(result + middle, surface.triangles)


def with_volume(surface: ClosedSurface, volume: float, farthest: float) -> ClosedSurface:
    """Move all vertices alike along their normals until the surface encloses a volume.

    Args:
        surface: closed, facing outwards.
        volume: m³.
        farthest: m; no vertex is moved farther, so a surface may stop short of the volume.
    """
    normals = vertex_normals(surface.vertices, surface.triangles)
    moved, distance = surface, 0.0
    for _ in range(4):  # Newton steps; each leaves the square of the error before
        missing = volume - moved.volume
        if abs(missing) <= 1e-6 * volume:
            break
        distance = float(np.clip(distance + missing / moved.area, -farthest, farthest))
        moved = ClosedSurface(surface.vertices + distance * normals, surface.triangles)
    return moved


def coarsened(surface: ClosedSurface, triangles: int) -> ClosedSurface:
    """Draw the same shape in about so many triangles: closed, with the same parts and genus.

    It keeps more where fewer would change that, or the volume by a hundredth.

    Raises:
        VolumeError: fast-simplification is not installed.
    """
    fraction = triangles / len(surface.triangles)
    while fraction < _NO_GAIN:
        tried = _simplified(surface, fraction)
        if len(tried.triangles) and not tried.fault:
            farthest = float(np.sqrt(tried.area / len(tried.triangles)))
            tried = with_volume(tried, surface.volume, farthest)
            alike = (tried.parts, tried.genus) == (surface.parts, surface.genus)
            if alike and abs(tried.volume / surface.volume - 1.0) < 0.01:
                return tried
        fraction *= 2.0
    return surface


def _simplified(surface: ClosedSurface, fraction: float) -> ClosedSurface:
    """Draw a surface with that fraction of its triangles; it may be closed no more."""
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
    # At the default aggressiveness of 7 errors are ten times as large as at 3.
    vertices, triangles = simplify(points, surface.triangles, 1.0 - fraction, agg=3)
    used, triangles = np.unique(triangles, return_inverse=True)
    placed = vertices[used].astype(np.float64) * size + middle
    return ClosedSurface(placed, triangles.reshape(-1, 3).astype(np.int32))
