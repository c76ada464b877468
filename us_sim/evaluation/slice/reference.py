"""What an image must show, by brute force in float64 with NumPy and SciPy alone.

It shares no arithmetic with the slicers: every pixel is tried in every tetrahedron whose bounding
box it lies in, and SciPy samples the volume.

>>> import numpy as np
>>> from us_sim.evaluation.slice.reference import exact_slice
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.slicing.probe.probe import LinearProbe
>>> from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
>>> from us_sim.volume.volume import Volume
>>> ramp = np.tile(np.arange(50, dtype=np.uint8), (41, 41, 1))
>>> to_patient = np.diag([1e-3, 1e-3, 1e-3, 1.0])
>>> to_patient[:2, 3] = -0.02
>>> mesh = box_mesh([-0.02, 0.02], [-0.02, 0.02], [0.0, 0.02, 0.04])
>>> plane = LinearProbe(aperture=0.02, depth=0.02, columns=8, rows=5).plane(Pose())
>>> volume = Volume(ramp, to_patient)
>>> exact_slice(volume, mesh.nodes, mesh.tetrahedra, mesh.nodes * [1, 1, 0.5], plane).grey[:, 0]
array([ 4., 12., 20., 28., 36.])
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from us_sim.slicing.probe.plane import SlicePlane
from us_sim.volume.volume import Volume

_CLOSED = -1e-9  # least barycentric coordinate of a point inside
_FLAT = 1e-6  # fraction of its rest volume below which a tetrahedron has no interior
_PAIRS = 1_000_000  # pairs of a pixel and a tetrahedron that are tried at once


@dataclass(frozen=True)
class ExactSlice:
    """What every pixel of an image shows."""

    rest: NDArray[np.float64]  # (rows, columns, 3) m; NaN where there is nothing
    tissue: NDArray[np.bool_]  # (rows, columns): in the deformed mesh
    grey: NDArray[np.float64]  # (rows, columns)


def exact_slice(
    volume: Volume,
    rest_nodes: NDArray[np.float64],
    tetrahedra: NDArray[np.int32],
    nodes: NDArray[np.float64],
    plane: SlicePlane,
) -> ExactSlice:
    """The image of tissue with its nodes at ``nodes`` (N, 3) m, as `slicing.slicer` defines it."""
    pixels = plane.pixels()
    rest = _located(rest_nodes, tetrahedra, nodes, plane)
    tissue = ~np.isnan(rest[..., 0])
    rest[~tissue] = pixels[~tissue]
    if not tissue.all():
        was = ~np.isnan(_located(rest_nodes, tetrahedra, rest_nodes, plane)[..., 0])
        rest[was & ~tissue] = np.nan
    return ExactSlice(rest, tissue, sampled(volume, rest))


def sampled(volume: Volume, rest: NDArray[np.float64]) -> NDArray[np.float64]:
    """Trilinear grey values at ``rest`` (rows, columns, 3) m; 0 at NaN and beyond the volume."""
    index = rest @ volume.patient_to_index[:3, :3].T + volume.patient_to_index[:3, 3]
    beyond = ~((index >= -0.5) & (index <= np.array(volume.shape) - 0.5)).all(axis=-1)
    index[beyond] = 0.0
    grey = ndimage.map_coordinates(
        volume.intensities, np.moveaxis(index, -1, 0), np.float64, order=1, mode="nearest"
    )
    grey[beyond] = 0.0
    return np.asarray(grey)


def voxel_distance(
    volume: Volume, one: NDArray[np.float64], other: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(rows, columns) voxels between two sets of positions (rows, columns, 3) m."""
    return np.asarray(np.linalg.norm((one - other) @ volume.patient_to_index[:3, :3].T, axis=-1))


def _located(
    rest_nodes: NDArray[np.float64],
    tetrahedra: NDArray[np.int32],
    nodes: NDArray[np.float64],
    plane: SlicePlane,
) -> NDArray[np.float64]:
    """(rows, columns, 3) m at rest of every pixel in the mesh; NaN of the others."""
    placed = nodes @ plane.to_pixel[:, :3].T + plane.to_pixel[:, 3]  # column, row, height
    corners = placed[tetrahedra]
    low, high = corners.min(axis=1), corners.max(axis=1)
    last = np.array([plane.columns - 1, plane.rows - 1, 0])
    first = np.maximum(np.ceil(low[:, :2] - 1e-6), 0).astype(int)
    end = np.minimum(np.floor(high[:, :2] + 1e-6), last[:2]).astype(int) + 1
    near = ((low <= last + 1e-6) & (high >= -1e-6)).all(axis=1) & (end > first).all(axis=1)
    before = _determinants(rest_nodes, tetrahedra)
    upright = _determinants(nodes, tetrahedra) * np.sign(before) > _FLAT * np.abs(before)
    chosen = np.flatnonzero(near & upright)

    found = np.full((plane.rows, plane.columns, 3), np.nan)
    counts = (end - first)[chosen].prod(axis=1)
    groups = np.searchsorted(np.cumsum(counts), np.arange(_PAIRS, counts.sum(), _PAIRS))
    for members in np.split(chosen, groups):
        width, height = (end - first)[members].T
        number = np.repeat(np.arange(len(members)), width * height)
        place = np.arange(len(number)) - np.repeat(
            np.cumsum(width * height) - width * height, width * height
        )
        row, column = np.divmod(place, width[number])
        column += first[members, 0][number]
        row += first[members, 1][number]
        edges = np.moveaxis(corners[members, 1:] - corners[members, :1], 1, 2)
        inverse = np.linalg.inv(edges)
        away = np.stack([column, row, np.zeros(len(row))], axis=1) - corners[members, 0][number]
        weights = np.einsum("pij,pj->pi", inverse[number], away)
        inside = (weights.min(axis=1) >= _CLOSED) & (weights.sum(axis=1) <= 1.0 - _CLOSED)
        number, weights = number[inside], weights[inside]
        origin = rest_nodes[tetrahedra[members]][number]
        found[row[inside], column[inside]] = origin[:, 0] + np.einsum(
            "pk,pki->pi", weights, origin[:, 1:] - origin[:, :1]
        )
    return found


def _determinants(nodes: NDArray[np.float64], tetrahedra: NDArray[np.int32]) -> NDArray[np.float64]:
    """(M,) m3, six times the signed volumes."""
    corners = nodes[tetrahedra]
    return np.asarray(np.linalg.det(corners[:, 1:] - corners[:, :1]))
