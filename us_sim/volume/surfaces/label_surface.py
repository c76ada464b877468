"""Surfaces around labelled structures of a volume, by marching cubes, and their STL files."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from us_sim.errors import VolumeError
from us_sim.volume.partial_file import partial_file
from us_sim.volume.volume import Volume

_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_SMOOTHING = 0.7  # grid steps, the least standard deviation that hides the voxels' stairs
_PADDING = 4  # grid steps
_LEVELS = (0.5, 0.4)
"""Levels between which the surface is drawn: at or below one half, as smoothing shrinks it."""
_STAIRS_LEVEL = 0.49
"""Below one half, where voxels that touch along an edge only would be joined or parted by chance,
and some edges of the surface would have four triangles. Now they are always joined."""


def make_label_surface(
    volume: Volume, label: int, spacing: float = 0.0, within: NDArray[np.float64] | None = None
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Make the closed surface around all voxels of a label, smoothed to hide their stairs.

    Structures that leave the volume, or the box, end there in a flat cap.

    Args:
        volume: with labels.
        label: its number.
        spacing: m, of the grid that is marched over; the voxels' own where that is wider.
        within: (2, 3) m, lower and upper corner of a box in ``patient`` that cuts the structure.

    Returns:
        (V, 3) m vertices in ``patient``, and (T, 3) triangles whose normals point outwards.

    Raises:
        VolumeError: the volume has no labels, the label does not occur (in the box), or it is
            thinner than the spacing can show.

    Examples:
        >>> import numpy as np
        >>> from us_sim.volume.volume import Volume
        >>> labels = np.zeros((40, 40, 40), np.uint8)
        >>> labels[10:30, 10:30, 10:30] = 6
        >>> placed = np.diag([1e-3, 1e-3, 1e-3, 1.0])
        >>> volume = Volume(np.zeros_like(labels), placed, labels=labels, label_names={6: "vein"})
        >>> vertices, triangles = make_label_surface(volume, 6)
        >>> vertices.min(axis=0).round(4), vertices.max(axis=0).round(4)
        (array([0.0095, 0.0095, 0.0095]), array([0.0295, 0.0295, 0.0295]))
    """
    from skimage.measure import marching_cubes

    mask, start = _voxels_of(volume, label, within)
    steps = np.maximum(1.0, spacing / np.linalg.norm(volume.index_to_patient[:3, :3], axis=0))
    pad = np.ceil(_PADDING * steps).astype(int)
    stairs = np.pad(mask.astype(np.float32), [(p, p) for p in pad])
    field = ndimage.gaussian_filter(stairs, _SMOOTHING * steps, mode="constant", truncate=3.0)
    if (steps > 1.0).any():
        shape = tuple(np.ceil(np.array(field.shape) / steps).astype(int))
        field = ndimage.affine_transform(field, np.diag(steps), output_shape=shape, order=1)
    elif field.max() <= _LEVELS[0]:
        field = stairs  # so thin that smoothing would leave nothing of it
    if field.max() <= _LEVELS[0]:
        raise VolumeError(
            f"{_numbered(volume, label)} is too thin for a surface {spacing * 1e3:.2g} mm fine: "
            f"allow more triangles"
        )
    level = _STAIRS_LEVEL
    if field is not stairs:
        wanted = np.count_nonzero(mask) / steps.prod()
        one, other = (
            abs(compute_enclosed_volume(*marching_cubes(field, at)[:2])) for at in _LEVELS
        )
        level = _LEVELS[0] + (wanted - one) / (other - one) * (_LEVELS[1] - _LEVELS[0])
        level = float(np.clip(level, 0.2, _LEVELS[0]))
    vertices, triangles = marching_cubes(field, level, gradient_direction="ascent")[:2]
    matrix = volume.index_to_patient
    placed = (vertices.astype(np.float64) * steps - pad + start) @ matrix[:3, :3].T + matrix[:3, 3]
    if np.linalg.det(matrix[:3, :3]) < 0.0:
        triangles = triangles[:, ::-1]  # to face outwards in ``patient``, too
    return placed, np.ascontiguousarray(triangles, dtype=np.int32)


def compute_enclosed_volume(vertices: NDArray[np.float64], triangles: NDArray[np.integer]) -> float:
    """Return m³ inside a closed surface by Gauss's theorem; below 0 where triangles face inwards.

    >>> corners = np.array([[0.0, 0, 0], [3, 0, 0], [0, 3, 0], [0, 0, 3]])
    >>> compute_enclosed_volume(corners, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))
    4.5
    """
    a, b, c = (vertices - vertices.mean(axis=0))[triangles.T]
    return float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6.0


def write_stl(path: Path, vertices: NDArray[np.float64], triangles: NDArray[np.integer]) -> None:
    """Write a surface to a binary file in millimetres; one of that name is replaced.

    Its header says that the axes are left, posterior and superior (``SPACE=LPS``), which 3D Slicer
    looks for; meshio writes no such header. Vertices are (V, 3) m, and triangles (T, 3) are
    counter-clockwise seen from outside.

    Raises:
        VolumeError: the file cannot be written.
    """
    facets = np.zeros(len(triangles), _FACET)
    a, b, c = vertices[triangles.T]
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    facets["normal"] = normals / np.maximum(lengths, 1e-30)
    facets["corners"] = 1e3 * vertices[triangles]
    header = b"us_sim; millimetres; SPACE=LPS".ljust(80)
    with partial_file(path) as partial:
        partial.write_bytes(header + np.uint32(len(facets)).tobytes() + facets.tobytes())


def choose_spacing(
    volume: Volume, labels: list[int], triangles: int, within: NDArray[np.float64] | None = None
) -> float:
    """Return m, the spacing at which surfaces of labels have about so many triangles together.

    Raises:
        VolumeError: as `make_label_surface`.
    """
    faces = 0.0
    sides = np.linalg.norm(volume.index_to_patient[:3, :3], axis=0)
    for label in labels:
        mask = np.pad(_voxels_of(volume, label, within)[0], 1)
        for axis, (one, other) in enumerate(itertools.combinations(sides[::-1], 2)):
            faces += one * other * np.count_nonzero(np.diff(mask, axis=axis))
    # Marching cubes makes two triangles for each square of the grid that the steps show.
    return float(np.sqrt(2.0 * faces / max(triangles, 1)))


def is_label_within(volume: Volume, label: int, within: NDArray[np.float64]) -> bool:
    """Tell whether a label has a voxel in a box, (2, 3) m in ``patient``."""
    try:
        _voxels_of(volume, label, within)
    except VolumeError:
        return False
    return True


def _numbered(volume: Volume, label: int) -> str:
    name = volume.label_names.get(label)
    return f"label {label} ({name})" if name else f"label {label}"


def _voxels_of(
    volume: Volume, label: int, within: NDArray[np.float64] | None = None
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Return a label's mask in the smallest block around it, and that block's first voxel (3,)."""
    if volume.labels is None:
        raise VolumeError("the volume has no labels, so nothing in it has a surface: segment it")
    block = ndimage.find_objects(volume.labels, max_label=label)[label - 1] if label > 0 else None
    if block is not None:
        mask = volume.labels[block] == label
        start = np.array([span.start for span in block])
        if within is not None:
            i, j, k = np.ogrid[block]
            for axis in range(3):
                a, b, c, d = volume.index_to_patient[axis]
                centres = a * i + b * j + c * k + d
                mask &= (centres >= within[0, axis]) & (centres <= within[1, axis])
            block = ndimage.find_objects(mask.view(np.uint8))[0] if mask.any() else None
        if block is not None:
            if within is not None:
                mask, start = mask[block], start + [span.start for span in block]
            return mask, start
    where = "" if within is None else " within the tissue mesh"
    raise VolumeError(
        f"{_numbered(volume, label)} occurs nowhere{where}, so it has no surface: name another "
        f"structure, or segment it again"
    )
