"""The surface of a labelled structure: drawn, smoothed with its volume kept, and decimated.

Smoothing is the windowed sinc filter of G. Taubin, T. Zhang and G. Golub, "Optimal surface
smoothing as filter design", ECCV 1996: a polynomial of the surface's umbrella operator in
Chebyshev's form, which does not shrink as Laplace's does. The volume that it still loses is given
back by moving every vertex a little along its normal. trimesh has no such filter.

Edges are collapsed by the quadric error of M. Garland and P. Heckbert, "Surface simplification
using quadric error metrics", SIGGRAPH 1997, in the library fast-simplification. That knows no
distance, so the fewest triangles whose measured distance is allowed are searched for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from us_sim.errors import UsSimError, VolumeError
from us_sim.geometry.triangles import vertex_normals
from us_sim.volume.surfaces.closed_surface import ClosedSurface
from us_sim.volume.surfaces.label_surface import structure_name, voxel_surface
from us_sim.volume.surfaces.settings import SurfaceSettings
from us_sim.volume.volume import Volume

_TRIALS = 6  # of decimation; each halves the logarithm of the range in which the answer lies
_NO_GAIN = 0.9  # of the triangles; a surface that keeps more stays as it is


@dataclass(frozen=True, eq=False)
class StructureSurface:
    """The surface of a structure, and the changes to it."""

    name: str
    label: int
    surface: ClosedSurface
    voxels_volume: float  # m³, of the label's voxels
    drawn: int  # triangles before decimation
    moved: float  # m, largest distance that decimation moved it

    @property
    def volume_kept(self) -> float:
        """The volume inside over that of the label's voxels."""
        return self.surface.volume / self.voxels_volume


def structure_surface(
    volume: Volume, label: int, settings: SurfaceSettings | None = None
) -> StructureSurface:
    """The closed surface around a label, facing outwards, with the volume of its voxels.

    Raises:
        VolumeError: the label does not occur, its surface is not closed, or a library is missing.
    """
    settings = settings or SurfaceSettings()
    name = structure_name(volume, label)
    surface, inside = voxel_surface(volume, label)
    spacing = float(np.linalg.norm(volume.index_to_patient[:3, :3], axis=0).mean())
    # The stairs of a surface that lies aslant are six voxels long at most nearly everywhere.
    wavelength = 6.0 * spacing if settings.smoothing is None else settings.smoothing
    if wavelength > 0.0:
        surface = smoothed(surface, wavelength, spacing)
    surface = with_volume(surface, inside, 0.5 * spacing)
    drawn, moved = len(surface.triangles), 0.0
    if settings.decimation > 0.0:
        surface, moved = decimated(surface, settings.decimation)
    if surface.fault:
        raise VolumeError(f"the surface of {name} is not closed: {surface.fault}")
    return StructureSurface(name, label, surface, inside, drawn, moved)


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


def filter_coefficients(pass_band: float, degree: int) -> NDArray[np.float64]:
    """(degree + 1,) coefficients of Chebyshev polynomials in 1 - k / 2 (Taubin 1996, section 4).

    They are those of an ideal low-pass filter, times a Hamming window, and made to sum to one so
    that a constant stays. ``np.polynomial.chebyshev.chebval(1 - k / 2, coefficients)`` of a bump
    with the eigenvalue k is left.

    Args:
        pass_band: the eigenvalue k, 0 to 2, at which the filter lets half through.
        degree: of the polynomial.

    >>> left = np.polynomial.chebyshev.chebval([1.0, 0.99, 0.5, 0.0], filter_coefficients(0.1, 20))
    >>> np.round(left, 2) + 0.0
    array([1.  , 0.95, 0.  , 0.  ])
    """
    angle = np.arccos(1.0 - pass_band / 2.0)
    n = np.arange(1, degree + 1)
    window = 0.54 + 0.46 * np.cos(n * np.pi / (degree + 1))
    ideal = 2.0 * np.sin(n * angle) / (n * np.pi)
    coefficients = np.concatenate([[angle / np.pi], window * ideal])
    return np.asarray(coefficients / coefficients.sum())


def _averaging(surface: ClosedSurface) -> csr_array:
    """(V, V) whose product with vertices is the mean of each one's neighbours.

    In a closed surface every edge has two triangles that run along it in opposite directions, so
    the triangles' directed edges name every neighbour once.
    """
    starts, ends = surface.half_edges
    count = len(surface.vertices)
    weights = 1.0 / np.maximum(np.bincount(starts, minlength=count), 1)
    return csr_array((weights[starts], (starts, ends)), shape=(count, count))


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
        distance += missing / moved.area
        distance = float(np.clip(distance, -farthest, farthest))
        moved = surface.moved_to(surface.vertices + distance * normals)
    return moved


def decimated(surface: ClosedSurface, farthest: float) -> tuple[ClosedSurface, float]:
    """The same shape in fewer triangles: closed, with the same volume, parts and genus, and nowhere
    farther than so many m from the closed surface given.

    Returns:
        The surface, the one given where hardly a triangle can go; and the distance in m between the
        two, see `surface_distance`.

    Raises:
        VolumeError: fast-simplification is not installed.
    """
    best, distance = surface, 0.0
    low, high = np.log(0.02), 0.0  # of the fraction of triangles that is kept
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

    It keeps more where fewer would change that, or the volume by a hundredth.

    Raises:
        VolumeError: fast-simplification is not installed.
    """
    fraction = triangles / len(surface.triangles)
    while fraction < _NO_GAIN:
        tried = _with_fraction(surface, fraction)
        if tried is not None:
            farthest = float(np.sqrt(tried.area / len(tried.triangles)))
            tried = with_volume(tried, surface.volume, farthest)
            if not tried.fault and abs(tried.volume / surface.volume - 1.0) < 0.01:
                return tried
        fraction *= 2.0
    return surface


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
    # At the default aggressiveness of 7 errors are ten times as large as at 3.
    vertices, triangles = simplify(points, surface.triangles, 1.0 - fraction, agg=3)
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


def surface_distance(one: ClosedSurface, other: ClosedSurface) -> float:
    """m, the largest distance from one to the other at their vertices and triangles' centres."""
    spacing = 2.0 * float(np.sqrt(min(s.area / len(s.triangles) for s in (one, other))))
    farthest = 0.0
    for a, b in ((one, other), (other, one)):
        points = np.concatenate([a.vertices, a.vertices[a.triangles].mean(axis=1)])
        farthest = max(farthest, float(distances_to(points, b, spacing).max()))
    return farthest


def distances_to(
    points: NDArray[np.float64], surface: ClosedSurface, spacing: float
) -> NDArray[np.float64]:
    """(P,) m, from points (P, 3) to the nearest of the triangles whose samples are nearest.

    Where another triangle is nearer still, a distance is too large, by less than the square of the
    samples' spacing, m, over the distance.
    """
    corners = surface.vertices[surface.triangles]  # (T, 3, 3)
    edges = np.roll(corners, -1, axis=1) - corners
    normals = np.cross(edges[:, 0], edges[:, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    inwards = np.cross(normals[:, None], edges)
    per_square = edges / (edges**2).sum(axis=2, keepdims=True)
    samples, owners = _samples(corners, spacing)
    _, near = cKDTree(samples).query(points, k=min(6, len(samples)))
    found = np.empty(len(points))
    for some in np.array_split(np.arange(len(points)), 1 + len(points) // 5000):
        around = owners[near[some]].reshape(len(some), -1)  # (P, K)
        off = points[some, None, None] - corners[around]  # (P, K, 3, 3)
        along = np.clip(np.einsum("pkex,pkex->pke", off, per_square[around]), 0.0, 1.0)
        off_edges = off - along[..., None] * edges[around]
        squared = np.einsum("pkex,pkex->pke", off_edges, off_edges).min(axis=2)
        above = (np.einsum("pkex,pkex->pke", off, inwards[around]) >= 0.0).all(axis=2)
        height = np.einsum("pkx,pkx->pk", off[:, :, 0], normals[around])
        found[some] = np.sqrt(np.where(above, height**2, squared).min(axis=1))
    return found


def _samples(
    corners: NDArray[np.float64], spacing: float
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Points (S, 3) in triangles (T, 3, 3), so many m apart, and whose they are (S,)."""
    longest = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).max(axis=1)
    parts = np.clip(np.ceil(longest / spacing), 1, 48).astype(np.int64)
    points, owners = [], []
    for count in np.unique(parts):
        which = np.flatnonzero(parts == count)
        i, j = (grid.ravel() for grid in np.indices((count, count)))
        one, other = ((each[i + j < count] + 1 / 3) / count for each in (i, j))
        weights = np.stack([1.0 - one - other, one, other])  # (3, samples)
        points.append(np.einsum("tvx,vs->tsx", corners[which], weights).reshape(-1, 3))
        owners.append(np.repeat(which, len(one)))
    return np.concatenate(points), np.concatenate(owners)
