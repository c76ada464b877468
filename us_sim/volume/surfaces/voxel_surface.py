"""The surface between a label's voxels and all others, by marching cubes, stairs and all.

>>> import numpy as np
>>> from us_sim.volume.surfaces.voxel_surface import voxel_surface
>>> from us_sim.volume.volume import Volume
>>> labels = np.zeros((20, 20, 20), np.uint8)
>>> labels[5:15, 5:15, 5:15] = 6
>>> placed = np.diag([1e-3, 1e-3, 1e-3, 1.0])
>>> surface, volume = voxel_surface(Volume(np.zeros_like(labels), placed, labels=labels), 6)
>>> round(volume * 1e6, 9), round(surface.volume * 1e6, 2), surface.fault  # ml; corners are cut
(1.0, 0.99, '')
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from us_sim.errors import VolumeError
from us_sim.volume.surfaces.closed_surface import ClosedSurface
from us_sim.volume.volume import Volume

_LEVEL = 0.49
"""Below one half, where voxels that touch along an edge only would be joined or parted by chance,
and some edges of the surface would have four triangles. Now they are always joined."""


def voxel_surface(volume: Volume, label: int) -> tuple[ClosedSurface, float]:
    """The closed surface around all voxels of a label, half a voxel beyond their centres.

    A structure that leaves the volume ends there in a flat cap.

    Args:
        volume: with labels.
        label: its number.

    Returns:
        The surface in ``patient``, and the volume of the label's voxels in m³.

    Raises:
        VolumeError: the volume has no labels, or none of its voxels has this one.
    """
    from skimage.measure import marching_cubes

    mask, start = _block_of(volume, label)
    vertices, triangles = marching_cubes(mask, _LEVEL, gradient_direction="ascent")[:2]
    matrix = volume.index_to_patient[:3, :3]
    if np.linalg.det(matrix) < 0.0:
        triangles = triangles[:, ::-1]
    indices = vertices.astype(np.float64) + start
    placed = indices @ matrix.T + volume.index_to_patient[:3, 3]
    voxel = abs(float(np.linalg.det(matrix)))
    return ClosedSurface(placed, triangles), voxel * float(np.count_nonzero(mask))


def structure_name(volume: Volume, label: int) -> str:
    """What a label is called, for a person."""
    return volume.label_names.get(label, f"label {label}")


def _block_of(volume: Volume, label: int) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """A label's mask with a border of zeros, and the index of its first voxel (3,)."""
    if volume.labels is None:
        raise VolumeError("the volume has no labels, so nothing in it has a surface: segment it")
    block = ndimage.find_objects(volume.labels, max_label=label)[label - 1] if label > 0 else None
    if block is None:
        raise VolumeError(
            f"{structure_name(volume, label)} occurs nowhere in the volume, so it has no surface: "
            f"name another structure, or segment it again"
        )
    mask = np.pad((volume.labels[block] == label).astype(np.float32), 1)
    return mask, np.array([span.start - 1 for span in block])
