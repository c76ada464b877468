"""The images of DICOM files that make a volume, their order, and their places and times.

DICOM says of every image where its first pixel is, which way its rows and columns go, and how far
apart pixels are (PS3.3, C.7.6.2). A volume is a set of such images at even distances along their
common normal, in any order. pydicom leaves this to others; highdicom 0.28 finds no coordinate
system in an Enhanced US Volume. Makers' own volumes are refused with a way out.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.files.dicom.header import (
    EXPORT,
    open_dicom,
    read_functional_groups,
    read_items,
    read_number,
    read_numbers,
    read_text,
    read_values,
)
from us_sim.volume.files.dicom.pixels import GreyImages
from us_sim.volume.files.placement import make_placement
from us_sim.volume.files.stored_image import stack_slices

SEGMENTATIONS = ("1.2.840.10008.5.1.4.1.1.66.4", "1.2.840.10008.5.1.4.1.1.66.7")
"""Classes of files that hold labels: masks of segments, and label maps."""

_PARALLEL = 1e-4  # difference of the components of directions that are the same
_EVEN = 0.02  # of the distance between images, by which one may be off
_ROUNDED = 0.01  # mm, to which some scanners round positions
_ALONG_AXES = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)


@dataclass(frozen=True)
class Plane:
    """The place of an image, its time, and the kind of its values."""

    position: tuple[float, ...]  # (3,) mm, centre of the first pixel
    orientation: tuple[float, ...]  # (6,) along a row, then along a column; unit vectors
    spacing: tuple[float, ...]  # (2,) mm, between rows, then between columns
    time: float = 0.0  # s, of its volume, where there are several
    kind: str = ""  # such as TISSUE_INTENSITY, where it is said


@dataclass(frozen=True, eq=False)
class PlacedImages:
    """The images of one volume, ordered along their normal."""

    images: GreyImages
    which: list[tuple[int, int]]  # of which file, and which of its images
    placement: NDArray[np.float64]  # (4, 4) m, from (column, row, image)
    volumes: int  # how many there are in time

    def read_voxels(self) -> NDArray[np.uint8]:
        """Read the grey values (i, j, k), a few images at a time."""
        return stack_slices(self.images.read_images(self.which), len(self.which))


def open_images(paths: Sequence[str | os.PathLike[str]]) -> GreyImages:
    """Open the images of one or several DICOM files."""
    files = [open_dicom(path) for path in paths]
    for file in files:
        if read_text(file, "SOPClassUID") in SEGMENTATIONS:
            raise VolumeError(
                f"{file.filename}: is a segmentation, which has labels and no grey values; save it "
                f"as .seg.nrrd in 3D Slicer, and give that to `us-sim segment CASE --labels`"
            )
    return GreyImages(files)


def place_images(
    images: GreyImages, volume: int = 1, spacing: Sequence[float] = ()
) -> PlacedImages:
    """Place the volume that DICOM files hold: an enhanced or multi-frame one, or an image each.

    Args:
        images: of the files, in any order.
        volume: which one where there are several in time, the first of which is 1.
        spacing: mm, width and height of pixels and distance of images, of files that state where
            their images lie, but not the size of pixels; or empty.

    Raises:
        VolumeError: the files hold no volume, or one that only its maker can read; or they do not
            belong together.
    """
    path = images.path
    for key in ("SeriesInstanceUID", "FrameOfReferenceUID"):
        if len({read_text(file, key) for file in images.files}) > 1:
            raise VolumeError(
                f"{path}: and the other files are of several series; give the files of one"
            )
    planes = _planes(images, spacing)
    if len({plane.position for plane in planes}) < 2:
        raise VolumeError(f"{path}: {_why_flat(images, planes)}")
    kinds = [plane.kind for plane in planes]
    kind = "TISSUE_INTENSITY" if "TISSUE_INTENSITY" in kinds else kinds[0]
    times = sorted({plane.time for plane in planes if plane.kind == kind})
    if not 1 <= volume <= len(times):
        raise VolumeError(
            f"{path}: holds {len(times)} volumes in time; number {volume} is none of them"
        )
    at = kind, times[volume - 1]
    chosen = [n for n, plane in enumerate(planes) if (plane.kind, plane.time) == at]
    shape = images.form.columns, images.form.rows, len(chosen)
    if min(shape) < 2:
        raise VolumeError(
            f"{path}: has {' × '.join(map(str, shape))} voxels; a volume needs two or more along "
            f"each axis"
        )
    if len({planes[n].position for n in chosen}) < len(chosen):
        raise VolumeError(
            f"{path}: several of its images are at the same place; give the files of one volume"
        )
    slices, placement = _grid_of(path, [planes[n] for n in chosen])
    steps = np.linalg.norm(placement[:3, :3], axis=0) * 1e3
    if spacing and not np.allclose(spacing, steps[: len(spacing)], rtol=0.02):
        shown = ",".join(f"{step:.5g}" for step in steps)
        raise VolumeError(f"{path}: its voxels are {shown} mm apart: leave out --spacing")
    which = [images.all[chosen[n]] for n in np.argsort(slices)]
    return PlacedImages(images, which, placement, len(times))


def _why_flat(images: GreyImages, planes: Sequence[Plane]) -> str:
    """Say what the files are that hold no volume, with advice."""
    count = len(images.all)
    if len(planes) == 1:
        return "is one slice of a volume; put the files of its series into one folder, and name it"
    if planes:
        return f"holds {count} images at one place, one after another in time, and no volume"
    if read_numbers(images.files[0], "ImagePositionPatient", 3):
        return (
            "states where its images lie, but not the size of pixels: say it with `us-sim import "
            "--spacing X,Y,Z` (mm)"
        )
    kind = "a 2D image" if count == 1 else f"2D, with {count} images"
    return f"is {kind}, not a volume: nothing says where its images lie; {EXPORT}"


def _grid_of(path: str, planes: Sequence[Plane]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return which slice of an even grid each image is, and (4, 4) m from (column, row, slice)."""
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
    return slices, make_placement(path, (columns, rows, step), axes, first)


def _image_axes(path: str, orientation: Sequence[float]) -> NDArray[np.float64]:
    """(3, 3) with columns along a row of the image, along a column, and along the normal."""
    along = np.array(orientation, np.float64).reshape(2, 3).T
    if np.abs(along.T @ along - np.eye(2)).max() > 1e-3:
        raise VolumeError(f"{path}: its rows and columns are not at right angles; export it again")
    return np.column_stack([along, np.cross(along[:, 0], along[:, 1])])


def _planes(images: GreyImages, spacing: Sequence[float]) -> list[Plane]:
    """Return the place of every image; none where a file does not state them."""
    files = zip(images.files, images.formats, strict=True)
    every = [_stated_planes(file, form.frames, spacing) for file, form in files]
    return [plane for own in every for plane in own] if all(every) else []


def _stated_planes(header: Any, frames: int, given: Sequence[float]) -> list[Plane]:
    """Return the place of each of a file's images; none where its header does not state it.

    ``given`` is the width and height of pixels, mm, of a header without it.

    - Enhanced objects: groups of values for each image or shared by all (PS3.3, C.7.6.16; C.8.24.6
      for ultrasound, in the volume's own frame of reference).
    - One image a file, with its position in the patient.
    - Several images with one position, and the distance of each (`GridFrameOffsetVector`) or of
      all (`SpacingBetweenSlices`).
    """
    if any(groups := read_functional_groups(header, frames)):
        planes = [
            Plane(
                _found(each, 3, "PlanePositionVolume ImagePositionVolume",
                       "PlanePosition ImagePositionPatient"),
                _found(each, 6, "PlaneOrientationVolume ImageOrientationVolume",
                       "PlaneOrientation ImageOrientationPatient"),
                _found(each, 2, "PixelMeasures PixelSpacing"),
                _time_of(each),
                _kind_of(each),
            )
            for each in groups
        ]  # fmt: skip
        stated = (plane.position and plane.orientation and plane.spacing for plane in planes)
        return planes if all(stated) else []
    position = read_numbers(header, "ImagePositionPatient", 3)
    orientation = read_numbers(header, "ImageOrientationPatient", 6)
    spacing = read_numbers(header, "PixelSpacing", 2) or tuple(given[1::-1])
    if position and orientation and spacing and frames == 1:
        return [Plane(position, orientation, spacing)]
    # FrameTime, FrameTimeVector
    is_cine = {0x00181063, 0x00181065} & set(read_values(header, "FrameIncrementPointer"))
    between = read_number(header, "SpacingBetweenSlices")
    offsets = read_numbers(header, "GridFrameOffsetVector", frames)
    if between and not offsets:
        offsets = tuple(n * between for n in range(frames))
    if not (spacing and offsets) or frames == 1 or is_cine:
        return []
    orientation = orientation or _ALONG_AXES
    normal = _image_axes(header.filename, orientation)[:, 2]
    first = np.array(position or (0.0, 0.0, 0.0))
    return [Plane(tuple(first + offset * normal), orientation, spacing) for offset in offsets]


def _found(groups: tuple[Any, ...], count: int, *places: str) -> tuple[float, ...]:
    """Read the numbers at the first of some places, a sequence and an element of its item."""
    for group in groups:
        for sequence, key in map(str.split, places):
            for item in read_items(group, f"{sequence}Sequence")[:1]:
                if found := read_numbers(item, key, count):
                    return found
    return ()


def _time_of(groups: tuple[Any, ...]) -> float:
    """Read the time of an image's volume, s; 0 where none is stated."""
    return next(iter(_found(groups, 1, "TemporalPosition TemporalPositionTimeOffset")), 0.0)


def _kind_of(groups: tuple[Any, ...]) -> str:
    """Read the kind of an image's values; empty where none is stated."""
    types = (item for group in groups for item in read_items(group, "ImageDataTypeSequence"))
    return next((read_text(item, "DataType") for item in types), "")
