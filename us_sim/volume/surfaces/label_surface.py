"""Surfaces around labelled structures of a volume, by marching cubes.

>>> import numpy as np
>>> from us_sim.volume.surfaces.label_surface import label_surface
>>> from us_sim.volume.volume import Volume
>>> labels = np.zeros((40, 40, 40), np.uint8)
>>> labels[10:30, 10:30, 10:30] = 6
>>> placed = np.diag([1e-3, 1e-3, 1e-3, 1.0])
>>> volume = Volume(np.zeros_like(labels), placed, labels=labels, label_names={6: "vein"})
>>> vertices, triangles = label_surface(volume, 6)
>>> vertices.min(axis=0).round(4), vertices.max(axis=0).round(4)  # m, half a voxel beyond centres
(array([0.0095, 0.0095, 0.0095]), array([0.0295, 0.0295, 0.0295]))

The surface between a label's voxels and all others, by marching cubes, stairs and all.

>>> import numpy as np
>>> from us_sim.volume.surfaces.label_surface import voxel_surface
>>> from us_sim.volume.volume import Volume
>>> labels = np.zeros((20, 20, 20), np.uint8)
>>> labels[5:15, 5:15, 5:15] = 6
>>> placed = np.diag([1e-3, 1e-3, 1e-3, 1.0])
>>> surface, volume = voxel_surface(Volume(np.zeros_like(labels), placed, labels=labels), 6)
>>> round(volume * 1e6, 9), round(surface.volume * 1e6, 2), surface.fault  # ml; corners are cut
(1.0, 0.99, '')
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from us_sim.errors import VolumeError
from us_sim.volume.surfaces.closed_surface import ClosedSurface
from us_sim.volume.volume import Volume

_SMOOTHING = 0.7
"""Standard deviation of the smoothing, in grid steps: the least that hides the voxels' stairs."""

_PADDING = 4  # grid steps

_TRIANGLES_PER_FACE = 2.0
"""Marching cubes makes two triangles for each square of the grid that a surface's steps show."""

_LEVELS = (0.5, 0.4)
"""Levels between which the surface is drawn: at or below one half, as smoothing shrinks it."""

_LOWEST_LEVEL = 0.2


def label_surface(
    volume: Volume,
    label: int,
    spacing: float = 0.0,
    within: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """The closed surface around all voxels of a label, smoothed to hide their stairs.

    Structures that leave the volume, or the box, end there in a flat cap.

    Args:
        volume: with labels.
        label: its number.
        spacing: m, of the grid that is marched over; the voxels' own where that is wider.
        within: (2, 3) m, lower and upper corner of a box in ``patient`` that cuts the structure.

    Returns:
        (V, 3) m vertices in ``patient``, and (T, 3) triangles whose normals point outwards.

    Raises:
        VolumeError: the volume has no labels, the label does not occur (in the box), it is thinner
            than the spacing can show, or scikit-image is not installed.
    """
    try:
        from skimage.measure import marching_cubes
    except ImportError as error:
        raise VolumeError(
            "surfaces of labelled structures need scikit-image; install it with "
            "`pip install scikit-image` or `apt install python3-skimage`"
        ) from error
    mask, start = _voxels_of(volume, label, within)
    matrix = volume.index_to_patient[:3, :3]
    steps = np.maximum(1.0, spacing / np.linalg.norm(matrix, axis=0))
    pad = np.ceil(_PADDING * steps).astype(int)
    field = np.pad(mask.astype(np.float32), [(p, p) for p in pad])
    ndimage.gaussian_filter(field, _SMOOTHING * steps, output=field, mode="constant", truncate=3.0)
    if (steps > 1.0).any():
        shape = tuple(np.ceil(np.array(field.shape) / steps).astype(int))
        field = ndimage.affine_transform(field, np.diag(steps), output_shape=shape, order=1)
    if field.max() <= _LEVELS[0]:
        raise VolumeError(
            f"label {label} ({volume.label_names.get(label, 'unnamed')}) is too thin for a surface "
            f"{spacing * 1e3:.2g} mm fine: allow more triangles"
        )
    wanted = np.count_nonzero(mask) / steps.prod()
    one, other = (_enclosed(*marching_cubes(field, level)[:2]) for level in _LEVELS)
    level = _LEVELS[0] + (wanted - one) / (other - one) * (_LEVELS[1] - _LEVELS[0])
    level = float(np.clip(level, _LOWEST_LEVEL, _LEVELS[0]))
    vertices, triangles = marching_cubes(field, level, gradient_direction="ascent")[:2]
    indices = vertices.astype(np.float64) * steps - pad + start
    if np.linalg.det(matrix) < 0.0:
        triangles = triangles[:, ::-1]
    placed = indices @ matrix.T + volume.index_to_patient[:3, 3]
    return placed, np.ascontiguousarray(triangles, dtype=np.int32)


def spacing_for(
    volume: Volume,
    labels: list[int],
    triangles: int,
    within: NDArray[np.float64] | None = None,
) -> float:
    """m, the spacing at which the surfaces of these labels have about so many triangles together.

    Raises:
        VolumeError: as `label_surface`.
    """
    faces = 0.0
    sides = np.linalg.norm(volume.index_to_patient[:3, :3], axis=0)
    for label in labels:
        mask, _ = _voxels_of(volume, label, within)
        mask = np.pad(mask, 1)
        for axis, (one, other) in enumerate(itertools.combinations(sides[::-1], 2)):
            faces += one * other * np.count_nonzero(np.diff(mask, axis=axis))
    return float(np.sqrt(_TRIANGLES_PER_FACE * faces / max(triangles, 1)))


def occurs(volume: Volume, label: int, within: NDArray[np.float64]) -> bool:
    """Whether a label has a voxel in a box, (2, 3) m in ``patient``."""
    try:
        _voxels_of(volume, label, within)
    except VolumeError:
        return False
    return True


def _enclosed(vertices: NDArray[np.floating], triangles: NDArray[np.integer]) -> float:
    """The volume inside a closed surface, by Gauss's theorem."""
    a, b, c = vertices.astype(np.float64)[triangles.T]
    return abs(float(np.einsum("ij,ij->", a, np.cross(b, c)))) / 6


def _voxels_of(
    volume: Volume, label: int, within: NDArray[np.float64] | None
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """A label's mask in the smallest block around it, and that block's first voxel (3,)."""
    if volume.labels is None:
        raise VolumeError("the volume has no labels, so nothing in it has a surface: segment it")
    mask = volume.labels == label
    start = np.zeros(3, dtype=np.int64)
    mask, start = _cropped(mask, start)
    if within is not None and mask.any():
        i, j, k = np.ogrid[tuple(slice(s, s + n) for s, n in zip(start, mask.shape, strict=True))]
        for axis in range(3):
            a, b, c, d = volume.index_to_patient[axis]
            centres = a * i + b * j + c * k + d
            mask &= (centres >= within[0, axis]) & (centres <= within[1, axis])
        mask, start = _cropped(mask, start)
    if not mask.any():
        where = "" if within is None else " within the tissue mesh"
        raise VolumeError(
            f"label {label} ({volume.label_names.get(label, 'unnamed')}) occurs nowhere{where}: "
            f"name another"
        )
    return mask, start


def _cropped(
    mask: NDArray[np.bool_], start: NDArray[np.int64]
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    for axis in range(3):
        others = tuple(other for other in range(3) if other != axis)
        held = np.flatnonzero(mask.any(axis=others))
        if not len(held):
            return mask, start
        cut = [slice(None)] * 3
        cut[axis] = slice(held[0], held[-1] + 1)
        mask = mask[tuple(cut)]
        start = start.copy()
        start[axis] += held[0]
    return mask, start


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
