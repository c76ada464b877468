"""Parallel images in space as one grid of voxels.

DICOM says of every image where its first pixel is, which way its rows and columns go, and how far
apart pixels are (PS3.3, C.7.6.2). A volume is a set of such images at even distances along their
common normal, in any order.

>>> import numpy as np
>>> from us_sim.volume.files.dicom.planes import Plane, grid_of
>>> rows_and_columns = (1.0, 0.0, 0.0, 0.0, 0.0, -1.0)
>>> planes = [Plane((0.0, y, 30.0), rows_and_columns, (0.5, 0.25)) for y in (4.0, 2.0, 0.0)]
>>> order, placement = grid_of("a.dcm", planes)
>>> order
[2, 1, 0]
>>> placement @ [4, 2, 1, 1]  # the fifth column, third row and second image
array([0.001, 0.002, 0.029, 1.   ])
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.files.placement import checked_placement

_PARALLEL = 1e-4  # difference of the components of directions that are the same
_EVEN = 0.02  # of the distance between images, by which one may be off
_PLACES = 0.01  # mm, to which some scanners round positions


@dataclass(frozen=True)
class Plane:
    """Where an image is."""

    position: tuple[float, ...]  # (3,) mm, centre of the first pixel
    orientation: tuple[float, ...]  # (6,) along a row, then along a column; unit vectors
    spacing: tuple[float, ...]  # (2,) mm, between rows, then between columns


def image_axes(path: Path | str, orientation: Sequence[float]) -> NDArray[np.float64]:
    """(3, 3) with columns along a row of the image, along a column, and along the normal.

    Raises:
        VolumeError: the first two are no unit vectors at right angles.
    """
    along = np.array(orientation, np.float64).reshape(2, 3).T
    if np.abs(along.T @ along - np.eye(2)).max() > 1e-3:
        raise VolumeError(
            f"{path}: the directions of its rows and columns are not at right angles; export it "
            f"again"
        )
    return np.column_stack([along, np.cross(along[:, 0], along[:, 1])])


def grid_of(path: Path | str, planes: Sequence[Plane]) -> tuple[list[int], NDArray[np.float64]]:
    """The order of images along their normal, and the (4, 4) m from (column, row, image).

    Raises:
        VolumeError: there is one image only, they are not parallel, are shifted against each
            other, are not at even distances, or lie where no body does.
    """
    if len(planes) < 2:
        raise VolumeError(
            f"{path}: is one image; a volume needs two or more: give all files of the series"
        )
    _check_parallel(path, planes)
    axes = image_axes(path, planes[0].orientation)
    positions = np.array([plane.position for plane in planes])
    depth = positions @ axes[:, 2]
    order = [int(n) for n in np.argsort(depth, kind="stable")]
    positions = positions[order]
    step = (positions[-1] - positions[0]) / (len(planes) - 1)
    distance = float(step @ axes[:, 2])
    _check_even(path, np.diff(depth[order]), distance)
    even = positions[0] + np.outer(np.arange(len(planes)), distance * axes[:, 2])
    if np.abs(positions - even).max() > max(_EVEN * distance, _PLACES):
        raise VolumeError(
            f"{path}: its images are shifted against each other ({np.abs(positions - even).max():g}"
            f" mm), so the grid is sheared; resample it on one with right angles"
        )
    rows, columns = planes[0].spacing
    return order, checked_placement(path, (columns, rows, distance), axes, positions[0])


def sparse_grid_of(
    path: Path | str, planes: Sequence[Plane], step: float | None
) -> tuple[list[int], NDArray[np.float64]]:
    """Which slice of a grid each image is, several of which may be the same and others missing,
    and the (4, 4) m from (column, row, slice).

    Args:
        path: which errors name.
        planes: of the images.
        step: mm, between slices; None for the smallest that there is.

    Raises:
        VolumeError: they are not parallel, are shifted against each other, lie between the slices,
            or where no body does.
    """
    _check_parallel(path, planes)
    axes = image_axes(path, planes[0].orientation)
    positions = np.array([plane.position for plane in planes])
    depth = positions @ axes[:, 2]
    gaps = np.diff(np.unique(np.round(depth / _PLACES) * _PLACES))
    step = step or (float(gaps.min()) if len(gaps) else 1.0)
    slices = np.rint((depth - depth.min()) / step)
    first = positions[int(np.argmin(depth))]
    apart = np.abs(positions - first - np.outer(slices * step, axes[:, 2])).max()
    if not apart <= max(_EVEN * step, _PLACES) * max(slices.max(), 1.0):
        raise VolumeError(
            f"{path}: its images are {apart:g} mm off an even grid of {step:g} mm; export it again"
        )
    rows, columns = planes[0].spacing
    return slices.astype(int).tolist(), checked_placement(path, (columns, rows, step), axes, first)


def _check_parallel(path: Path | str, planes: Sequence[Plane]) -> None:
    orientation = np.array([plane.orientation for plane in planes])
    spacing = np.array([plane.spacing for plane in planes])
    if (
        np.ptp(orientation, axis=0).max() > _PARALLEL
        or np.ptp(spacing, axis=0).max() > _PARALLEL * np.abs(spacing).max()
    ):
        raise VolumeError(
            f"{path}: its images are not parallel, or their pixels differ in size, so they are no "
            f"grid; export a volume with even slices"
        )


def _check_even(path: Path | str, gaps: NDArray[np.float64], distance: float) -> None:
    if not np.isfinite(gaps).all() or gaps.min() < 1e-4:
        raise VolumeError(
            f"{path}: several of its images are at the same place, and not one volume after "
            f"another; give the files of one volume"
        )
    if np.abs(gaps - distance).max() > max(_EVEN * distance, _PLACES):
        raise VolumeError(
            f"{path}: its images are {gaps.min():g} to {gaps.max():g} mm apart, which is not even: "
            f"one may be missing"
        )
