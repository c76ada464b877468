"""The place and time of DICOM's images, as their header states them, and the grid that they make.

DICOM says of every image where its first pixel is, which way its rows and columns go, and how far
apart pixels are (PS3.3, C.7.6.2). A volume is a set of such images at even distances along their
common normal, in any order. pydicom leaves this to others; highdicom 0.28 finds no coordinate
system in an Enhanced US Volume.

Three makers' volumes are read as 3D Slicer's SlicerHeart and ITK-SNAP read them: Philips' Cartesian
export from QLAB, Philips Affiniti, and Eigen Artemis. None of them says where the patient is: the
axes are those of the grid. All others are refused with a way out.
"""

from __future__ import annotations

import copy
import math
import re
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.files.dicom.header import DicomFile, items, number, numbers, private, text, whole
from us_sim.volume.files.dicom.header import value as value_of
from us_sim.volume.files.placement import checked_placement

_PARALLEL = 1e-4  # difference of the components of directions that are the same
_EVEN = 0.02  # of the distance between images, by which one may be off
_PLACES = 0.01  # mm, to which some scanners round positions
_ALONG_AXES = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
_CARTESIAN = "1.2.840.113543.6.6.1.3.10002"

_SAVE = "and save the volume as .nrrd"
_QLAB = "export it as Cartesian DICOM (3DDCM) from QLAB or Ultrasound Workspace"
_IMAGE3D = f"export an Enhanced US Volume, or open it in 3D Slicer with the maker's loader {_SAVE}"
_HIDDEN = (
    (0x7FE1, "KRETZ_US", "GE (Kretz)", f"open it in 3D Slicer with SlicerHeart {_SAVE}"),
    (0x7FE1, "GEMS_Ultrasound_MovieGroup_001", "GE (movie group)", _IMAGE3D),
    (0x200D, "Philips US Imaging DD", "Philips", _QLAB),
    (0x200D, "Philips US Private 3D", "Philips", _QLAB),
    (0x0039, "SIEMENS MED SMS USG ANTARES 3D VOLUME", "Siemens", _IMAGE3D),
    (0x0139, "SIEMENS MED SMS USG S2000 3D VOLUME", "Siemens", _IMAGE3D),
)
"""Group, beginning of the creator's name as in DCMTK's dictionary, maker, advice."""


@dataclass(frozen=True)
class Plane:
    """The place of an image."""

    position: tuple[float, ...]  # (3,) mm, centre of the first pixel
    orientation: tuple[float, ...]  # (6,) along a row, then along a column; unit vectors
    spacing: tuple[float, ...]  # (2,) mm, between rows, then between columns


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
    axes, positions, depth = _along_normal(path, planes)
    order = [int(n) for n in np.argsort(depth, kind="stable")]
    positions = positions[order]
    distance = float((positions[-1] - positions[0]) / (len(planes) - 1) @ axes[:, 2])
    gaps = np.diff(depth[order])
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
    even = positions[0] + np.outer(np.arange(len(planes)), distance * axes[:, 2])
    if (off := np.abs(positions - even).max()) > max(_EVEN * distance, _PLACES):
        raise VolumeError(
            f"{path}: its images are shifted against each other ({off:g} mm), so the grid is "
            f"sheared; resample it on one with right angles"
        )
    rows, columns = planes[0].spacing
    return order, checked_placement(path, (columns, rows, distance), axes, positions[0])


def sparse_grid_of(
    path: Path | str, planes: Sequence[Plane], step: float | None
) -> tuple[list[int], NDArray[np.float64]]:
    """Which slice of a grid each image is, several of which may be the same and others missing,
    and the (4, 4) m from (column, row, slice).

    ``step`` is the distance of slices in mm; None for the smallest that there is.

    Raises:
        VolumeError: they are not parallel, are shifted against each other, lie between the slices,
            or where no body does.
    """
    axes, positions, depth = _along_normal(path, planes)
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


def _along_normal(
    path: Path | str, planes: Sequence[Plane]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Axes (3, 3) of parallel images, their positions (N, 3) mm and depths (N,) along it."""
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
    axes = _image_axes(path, planes[0].orientation)
    positions = np.array([plane.position for plane in planes])
    return axes, positions, positions @ axes[:, 2]


def _image_axes(path: Path | str, orientation: Sequence[float]) -> NDArray[np.float64]:
    """(3, 3) with columns along a row of the image, along a column, and along the normal."""
    along = np.array(orientation, np.float64).reshape(2, 3).T
    if np.abs(along.T @ along - np.eye(2)).max() > 1e-3:
        raise VolumeError(
            f"{path}: the directions of its rows and columns are not at right angles; export it "
            f"again"
        )
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
    if groups := _groups(header, frames):
        return _planes_of_groups(groups)
    position = numbers(header, "ImagePositionPatient", 3)
    orientation = numbers(header, "ImageOrientationPatient", 6)
    spacing = numbers(header, "PixelSpacing", 2) or tuple(given[1::-1])
    if position and orientation and spacing and frames == 1:
        return [Plane(position, orientation, spacing)]
    pointer = value_of(header, "FrameIncrementPointer")
    listed = [pointer] if isinstance(pointer, int) else list(pointer or ())
    is_cine = any(each in (0x00181063, 0x00181065) for each in listed)  # FrameTime, FrameTimeVector
    if not spacing or frames == 1 or is_cine:
        return None
    offsets = numbers(header, "GridFrameOffsetVector", frames)
    between = number(header, "SpacingBetweenSlices")
    if offsets is None and between:
        offsets = tuple(n * between for n in range(frames))
    if offsets is None:
        return None
    orientation = orientation or _ALONG_AXES
    normal = _image_axes(file.path, orientation)[:, 2]
    first = np.array(position or (0.0, 0.0, 0.0))
    return [Plane(tuple(first + offset * normal), orientation, spacing) for offset in offsets]


def image_times(file: DicomFile, frames: int) -> list[float]:
    """For each image the time of its volume, s, where there are several; else 0."""
    times = []
    for group in _groups(file.header, frames) or [()] * frames:
        found = _found(group, ("TemporalPositionSequence TemporalPositionTimeOffset",), 1)
        times.append(found[0] if found else 0.0)
    return times


def image_kinds(file: DicomFile, frames: int) -> list[str]:
    """For each image the kind of its values, such as TISSUE_INTENSITY; empty where none is said."""
    kinds = []
    for group in _groups(file.header, frames) or [()] * frames:
        described = [each for part in group for each in items(part, "ImageDataTypeSequence")]
        kinds.append(text(described[0], "DataType") if described else "")
    return kinds


def _groups(header: Any, frames: int) -> list[tuple[Any, ...]]:
    """For each image its own group of values, then that shared by all."""
    shared = items(header, "SharedFunctionalGroupsSequence")[:1]
    own = items(header, "PerFrameFunctionalGroupsSequence")
    return [(group, *shared) for group in own] if len(own) == frames else []


def _planes_of_groups(groups: list[tuple[Any, ...]]) -> list[Plane] | None:
    planes = []
    for group in groups:
        position = _found(
            group,
            ("PlanePositionVolumeSequence ImagePositionVolume",
             "PlanePositionSequence ImagePositionPatient"), 3,
        )  # fmt: skip
        orientation = _found(
            group,
            ("PlaneOrientationVolumeSequence ImageOrientationVolume",
             "PlaneOrientationSequence ImageOrientationPatient"), 6,
        )  # fmt: skip
        spacing = _found(group, ("PixelMeasuresSequence PixelSpacing",), 2)
        if not (position and orientation and spacing):
            return None
        planes.append(Plane(position, orientation, spacing))
    return planes


def _found(
    groups: tuple[Any, ...], places: tuple[str, ...], count: int
) -> tuple[float, ...] | None:
    """The numbers at the first of some places, each a sequence and an element of its first item."""
    for group in groups:
        for sequence, key in map(str.split, places):
            for item in items(group, sequence)[:1]:
                if (found := numbers(item, key, count)) is not None:
                    return found
    return None


def is_cartesian(file: DicomFile) -> bool:
    """Whether it is Philips' Cartesian export."""
    return text(file.header, "SOPClassUID") == _CARTESIAN


def one_image_after_another(file: DicomFile) -> DicomFile:
    """The file as if its header counted images; Philips' Cartesian export counts volumes.

    Raises:
        VolumeError: its number of slices is missing.
    """
    if not is_cartesian(file):
        return file
    slices = _private_number(file.header, 0x30011001)
    volumes = max(whole(file.header, "NumberOfFrames") or 1, 1)
    if slices is None or slices != int(slices) or slices < 2:
        raise VolumeError(
            f"{file.path}: is a Cartesian export of Philips that does not say how many slices it "
            f"has; {_QLAB} again"
        )
    header = copy.copy(file.header)
    header.NumberOfFrames = int(min(volumes * slices, 1 << 30))
    return replace(file, header=header)


def vendor_planes(file: DicomFile, frames: int) -> tuple[list[Plane], list[float]] | None:
    """The places of images that a maker states in a way of its own, and their times in s.

    - Philips' Cartesian export: the number of slices and their distance in the private elements
      (3001,1001) and (3001,1003), the other distances in the standard's; all in cm.
    - Philips Affiniti: the distances in mm in an element of "Philips US Imaging DD 036".
    - Eigen Artemis: voxels whose edge in mm is a thousandth of the pixels' aspect ratio.

    The file is as `one_image_after_another` returns it.
    """
    header = file.header
    if is_cartesian(file):
        x, y = number(header, "PhysicalDeltaX"), number(header, "PhysicalDeltaY")
        z = _private_number(header, 0x30011003)
        slices = int(_private_number(header, 0x30011001) or 0)
        if not (x and y and z and slices):
            return None
        step = (number(header, "FrameTime") or 1000.0) * 1e-3  # s
        grid = _stack((x * 10.0, y * 10.0, z * 10.0), slices)
        return grid * (frames // slices), [step * (n // slices) for n in range(frames)]
    tag = private(header, 0x200D, "Philips US Imaging DD 036", 0x03)
    spacing = numbers(header, tag, 3) if tag is not None else None
    if spacing and frames > 1:
        return _stack(spacing, frames), [0.0] * frames
    maker = text(header, "Manufacturer"), text(header, "ManufacturerModelName")
    if maker == ("Eigen", "Artemis") and frames > 1:
        edge = (number(header, "PixelAspectRatio") or 0.0) / 1000
        size = (whole(header, "Columns") or 0, whole(header, "Rows") or 0)
        return _stack((edge, edge, edge), frames, about=size), [0.0] * frames
    return None


def _stack(
    spacing: Sequence[float], count: int, about: tuple[int, int] | None = None
) -> list[Plane]:
    """Images one behind the other along the grid's axes, from 0 or about it; spacing x y z."""
    x, y, z = spacing
    corner = [0.0, 0.0, 0.0]
    if about is not None:
        corner = [-(n - 1) / 2 * s for n, s in zip((*about, count), spacing, strict=True)]
    return [
        Plane((corner[0], corner[1], corner[2] + n * z), _ALONG_AXES, (y, x)) for n in range(count)
    ]


def _private_number(header: Any, tag: int) -> float | None:
    """A number whose type the file does not say: as text, whole, or in double precision."""
    found = value_of(header, tag)
    if not isinstance(found, bytes):
        return number(header, tag)
    try:
        form = {2: "<H", 4: "<I", 8: "<d"}.get(len(found))
        made = float(struct.unpack(form, found)[0] if form else found.decode("ascii"))
    except (ValueError, struct.error):
        return None
    return made if math.isfinite(made) else None


def hidden_volume(file: DicomFile) -> str:
    """Advice about a volume that is there, but in a form only its maker knows; or nothing."""
    for group, creator, maker, remedy in _HIDDEN:
        for block in range(0x10, 0x100):
            if text(file.header, (group << 16) | block).startswith(creator):
                return f"it has private data of {maker}, where a volume may be: {remedy}"
    return ""


def frame_times(file: DicomFile, frames: int) -> list[float] | None:
    """Times of a cine's images in s, from the first on; None where the header does not state them.

    `FrameTimeVector` says how long after the one before it each image came, `FrameTime` and the
    rates say it of all (PS3.3, C.7.6.5). Without these, images of enhanced objects state their own
    times (PS3.3, C.7.6.16.2).
    """
    header = file.header
    steps = numbers(header, "FrameTimeVector", frames)  # ms
    if steps and all(0.0 <= step < 1e7 for step in steps[1:]):
        return list(accumulate((step * 1e-3 for step in steps[1:]), initial=0.0))
    step = number(header, "FrameTime")
    if not step or not 0.0 < step < 1e7:
        rate = number(header, "CineRate") or number(header, "RecommendedDisplayFrameRate")
        step = 1.0 / rate / 1e-3 if rate and rate > 1e-3 else None
    if step is None:
        return [0.0] if frames == 1 else _own_times(file, frames)
    return [frame * step * 1e-3 for frame in range(frames)]


def _own_times(file: DicomFile, frames: int) -> list[float] | None:
    """Of the images' own times those in which each image is later than the one before it."""
    groups = items(file.header, "PerFrameFunctionalGroupsSequence")
    contents = [item for group in groups for item in items(group, "FrameContentSequence")[:1]]
    keys = ("FrameReferenceDateTime", "FrameAcquisitionDateTime")
    stamps = [list(_stamps(contents, key)) for key in keys]
    since = [[(stamp - each[0]).total_seconds() for stamp in each] for each in stamps]
    for times in (image_times(file, frames), *since):
        if len(times) == frames and all(a < b for a, b in pairwise(times)):
            return [time - times[0] for time in times]
    return None


def _stamps(contents: list[Any], key: str) -> Iterator[datetime]:
    """Dates and times of value representation DT (PS3.5, 6.2) of the items that state them."""
    for item in contents:
        if found := re.fullmatch(r"(\d{14})(\.\d{1,6})?([+-]\d{4})?", text(item, key)):
            day, part, zone = found.groups("")
            try:
                stated = f"{day}{part or '.0'}{zone or '+0000'}"
                yield datetime.strptime(stated, "%Y%m%d%H%M%S.%f%z")
            except ValueError:  # no such day, hour or zone
                continue
