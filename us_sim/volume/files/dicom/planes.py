"""The place and time of DICOM's images, as their header states them, and the grid that they make.

DICOM says of every image where its first pixel is, which way its rows and columns go, and how far
apart pixels are (PS3.3, C.7.6.2). A volume is a set of such images at even distances along their
common normal, in any order. pydicom leaves this to others; highdicom 0.28 finds no coordinate
system in an Enhanced US Volume.

Makers' own volumes are refused with a way out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.files.dicom.header import (
    DicomFile,
    groups_of,
    items,
    number,
    numbers,
    text,
    values,
)
from us_sim.volume.files.placement import checked_placement

_PARALLEL = 1e-4  # difference of the components of directions that are the same
_EVEN = 0.02  # of the distance between images, by which one may be off
_ROUNDED = 0.01  # mm, to which some scanners round positions
_ALONG_AXES = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)

EXPORT = (
    "export a maker's own 3D data as Enhanced US Volume, or save it as .nrrd in 3D Slicer with "
    "SlicerHeart"
)
"""Advice for GE's Kretz and movie groups, Philips' and Siemens' volumes."""


@dataclass(frozen=True)
class Plane:
    """The place of an image."""

    position: tuple[float, ...]  # (3,) mm, centre of the first pixel
    orientation: tuple[float, ...]  # (6,) along a row, then along a column; unit vectors
    spacing: tuple[float, ...]  # (2,) mm, between rows, then between columns


def grid_of(path: Path | str, planes: Sequence[Plane]) -> tuple[list[int], NDArray[np.float64]]:
    """Return which slice of an even grid each image is, and (4, 4) m from (column, row, slice).

    Args:
        path: which errors name.
        planes: of two images or more.
    """
    orientation, spacing, positions = (
        np.array([getattr(plane, key) for plane in planes])
        for key in ("orientation", "spacing", "position")
    )
    apart = np.ptp(orientation, axis=0).max(), np.ptp(spacing / spacing.max(), axis=0).max()
    if max(apart) > _PARALLEL:
        raise VolumeError(
            f"{path}: its images are not parallel, or their pixels differ in size; export a volume "
            f"with even slices"
        )
    axes = _image_axes(path, planes[0].orientation)
    depth = positions @ axes[:, 2]
    step = float(np.ptp(depth)) / (len(planes) - 1) or 1.0
    slices = np.rint((depth - depth.min()) / step)
    first = positions[int(np.argmin(depth))]
    off = np.abs(positions - first - np.outer(slices * step, axes[:, 2])).max()
    is_whole = np.array_equal(np.sort(slices), np.arange(len(planes)))
    if not is_whole or not off <= max(_EVEN * step, _ROUNDED):
        gaps = np.diff(np.sort(depth))
        raise VolumeError(
            f"{path}: its images are {gaps.min():g} to {gaps.max():g} mm apart and shifted by up "
            f"to {off:g} mm against an even grid: one may be missing"
        )
    rows, columns = planes[0].spacing
    return slices.astype(int).tolist(), checked_placement(path, (columns, rows, step), axes, first)


def _image_axes(path: Path | str, orientation: Sequence[float]) -> NDArray[np.float64]:
    """(3, 3) with columns along a row of the image, along a column, and along the normal."""
    along = np.array(orientation, np.float64).reshape(2, 3).T
    if np.abs(along.T @ along - np.eye(2)).max() > 1e-3:
        raise VolumeError(f"{path}: its rows and columns are not at right angles; export it again")
    return np.column_stack([along, np.cross(along[:, 0], along[:, 1])])


def stated_planes(file: DicomFile, frames: int, given: Sequence[float] = ()) -> list[Plane] | None:
    """Return the place of each of the images; None where the header does not state it.

    ``given`` is the width and height of pixels, mm, of a header without it.

    - Enhanced objects: groups of values for each image or shared by all (PS3.3, C.7.6.16; C.8.24.6
      for ultrasound, in the volume's own frame of reference).
    - One image a file, with its position in the patient.
    - Several images with one position, and the distance of each (`GridFrameOffsetVector`) or of
      all (`SpacingBetweenSlices`).
    """
    header = file.header
    if any(groups := groups_of(header, frames)):
        planes = [
            Plane(
                _found(each, 3, "PlanePositionVolume ImagePositionVolume",
                       "PlanePosition ImagePositionPatient"),
                _found(each, 6, "PlaneOrientationVolume ImageOrientationVolume",
                       "PlaneOrientation ImageOrientationPatient"),
                _found(each, 2, "PixelMeasures PixelSpacing"),
            )
            for each in groups
        ]  # fmt: skip
        stated = (plane.position and plane.orientation and plane.spacing for plane in planes)
        return planes if all(stated) else None
    position = numbers(header, "ImagePositionPatient", 3)
    orientation = numbers(header, "ImageOrientationPatient", 6)
    spacing = numbers(header, "PixelSpacing", 2) or tuple(given[1::-1])
    if position and orientation and spacing and frames == 1:
        return [Plane(position, orientation, spacing)]
    # FrameTime, FrameTimeVector
    is_cine = {0x00181063, 0x00181065} & set(values(header, "FrameIncrementPointer"))
    between = number(header, "SpacingBetweenSlices")
    offsets = numbers(header, "GridFrameOffsetVector", frames)
    if between and not offsets:
        offsets = tuple(n * between for n in range(frames))
    if not (spacing and offsets) or frames == 1 or is_cine:
        return None
    orientation = orientation or _ALONG_AXES
    normal = _image_axes(file.path, orientation)[:, 2]
    first = np.array(position or (0.0, 0.0, 0.0))
    return [Plane(tuple(first + offset * normal), orientation, spacing) for offset in offsets]


def _found(groups: tuple[Any, ...], count: int, *places: str) -> tuple[float, ...]:
    """Read the numbers at the first of some places, a sequence and an element of its item."""
    for group in groups:
        for sequence, key in map(str.split, places):
            for item in items(group, f"{sequence}Sequence")[:1]:
                if found := numbers(item, key, count):
                    return found
    return ()


def image_times(file: DicomFile, frames: int) -> list[float]:
    """Return for each image the time of its volume, s, where there are several; else 0."""
    place = "TemporalPosition TemporalPositionTimeOffset"
    return [(_found(each, 1, place) or (0.0,))[0] for each in groups_of(file.header, frames)]


def image_kinds(file: DicomFile, frames: int) -> list[str]:
    """Return the kind of each image's values, such as TISSUE_INTENSITY; empty if none is said."""
    every = [
        [text(each, "DataType") for part in group for each in items(part, "ImageDataTypeSequence")]
        for group in groups_of(file.header, frames)
    ]
    return [(*kinds, "")[0] for kinds in every]


def frame_times(file: DicomFile, frames: int) -> list[float] | None:
    """Return times of a cine's images in s, from the first on; None where none are stated.

    `FrameTimeVector` says how long after the one before it each image came, `FrameTime` and the
    rates say it of all (PS3.3, C.7.6.5). Without these, images of enhanced objects may state the
    times of their volumes.
    """
    header = file.header
    steps = numbers(header, "FrameTimeVector", frames)[1:]  # ms
    if not steps:
        rate = number(header, "CineRate") or number(header, "RecommendedDisplayFrameRate")
        step = number(header, "FrameTime") or (1e3 / rate if rate else None)
        steps = (step,) * (frames - 1) if step else ()
    if frames == 1 or (steps and all(0.0 <= step < 1e7 for step in steps)):
        return list(accumulate((step * 1e-3 for step in steps), initial=0.0))
    times = image_times(file, frames)
    is_rising = len(times) == frames and all(a < b for a, b in pairwise(times))
    return [time - times[0] for time in times] if is_rising else None
