"""Where the images of a DICOM file are, as far as its header states it.

- Enhanced US Volume and other enhanced objects: groups of values for each image or shared by all
  (PS3.3, C.7.6.16; C.8.24.6 for ultrasound, in the volume's own frame of reference).
- One image a file, with its position in the patient.
- Several images with one position, and the distance of each (`GridFrameOffsetVector`) or of all
  (`SpacingBetweenSlices`).
"""

from __future__ import annotations

from typing import Any

from us_sim.volume.files.dicom.header import DicomFile
from us_sim.volume.files.dicom.planes import Plane, image_axes
from us_sim.volume.files.dicom.values import items, number, numbers, text, value

_ALONG_AXES = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
_CINE = (0x00181063, 0x00181065)  # FrameTime, FrameTimeVector
_PLACES = (
    ("PlanePositionVolumeSequence", "ImagePositionVolume"),
    ("PlanePositionSequence", "ImagePositionPatient"),
)
_DIRECTIONS = (
    ("PlaneOrientationVolumeSequence", "ImageOrientationVolume"),
    ("PlaneOrientationSequence", "ImageOrientationPatient"),
)
_SIZES = (("PixelMeasuresSequence", "PixelSpacing"),)


def stated_planes(file: DicomFile, frames: int) -> list[Plane] | None:
    """The place of each of the images; None where the header does not state it."""
    header = file.header
    if groups := _groups(header, frames):
        return _of_groups(groups)
    position = numbers(header, "ImagePositionPatient", 3)
    orientation = numbers(header, "ImageOrientationPatient", 6)
    spacing = numbers(header, "PixelSpacing", 2)
    if position and orientation and spacing and frames == 1:
        return [Plane(position, orientation, spacing)]
    if not spacing or frames == 1 or is_cine(header):
        return None
    offsets = numbers(header, "GridFrameOffsetVector", frames)
    between = number(header, "SpacingBetweenSlices")
    if offsets is None and between:
        offsets = tuple(n * between for n in range(frames))
    if offsets is None:
        return None
    orientation = orientation or _ALONG_AXES
    normal = image_axes(file.path, orientation)[:, 2]
    first = position or (0.0, 0.0, 0.0)
    return [
        Plane(
            tuple(a + offset * b for a, b in zip(first, normal, strict=True)), orientation, spacing
        )
        for offset in offsets
    ]


def is_cine(header: Any) -> bool:
    """Whether a file says that its images follow each other in time."""
    pointer = value(header, "FrameIncrementPointer")
    listed = [pointer] if isinstance(pointer, int) else list(pointer or ())
    return any(each in _CINE for each in listed)


def image_times(file: DicomFile, frames: int) -> list[float]:
    """For each image the time of its volume, s, where there are several; else 0."""
    times = []
    for group in _groups(file.header, frames) or [()] * frames:
        found = _found(group, (("TemporalPositionSequence", "TemporalPositionTimeOffset"),), 1)
        times.append(found[0] if found else 0.0)
    return times


def image_kinds(file: DicomFile, frames: int) -> list[str]:
    """For each image what its values are, such as TISSUE_INTENSITY; empty where nothing says it."""
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


def _of_groups(groups: list[tuple[Any, ...]]) -> list[Plane] | None:
    planes = []
    for group in groups:
        position = _found(group, _PLACES, 3)
        orientation = _found(group, _DIRECTIONS, 6)
        spacing = _found(group, _SIZES, 2)
        if not (position and orientation and spacing):
            return None
        planes.append(Plane(position, orientation, spacing))
    return planes


def _found(
    groups: tuple[Any, ...], where: tuple[tuple[str, str], ...], count: int
) -> tuple[float, ...] | None:
    """The numbers of the first group that has them."""
    for group in groups:
        for sequence, key in where:
            for item in items(group, sequence)[:1]:
                found = numbers(item, key, count)
                if found is not None:
                    return found
    return None
