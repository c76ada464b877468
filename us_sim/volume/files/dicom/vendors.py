"""Volumes that makers of scanners keep in ways of their own, and how to get at those.

Three are read, as 3D Slicer's SlicerHeart and ITK-SNAP read them:

- Philips' Cartesian export from QLAB (a storage class of its own): the number of slices and their
  distance in the private elements (3001,1001) and (3001,1003), the other distances in cm in the
  standard's;
- Philips Affiniti: the distances in mm in a private element of "Philips US Imaging DD 036";
- Eigen Artemis: voxels whose edge in mm is a thousandth of the pixels' aspect ratio.

All others are refused with what a person can do. None of the three says where the patient is: the
axes are those of the grid.
"""

from __future__ import annotations

import copy
import math
import struct
from collections.abc import Sequence
from typing import Any

from us_sim.errors import VolumeError
from us_sim.volume.files.dicom.header import DicomFile
from us_sim.volume.files.dicom.planes import Plane
from us_sim.volume.files.dicom.values import number, numbers, private, text, value, whole

_CARTESIAN = "1.2.840.113543.6.6.1.3.10002"
_CENTIMETRES = 10.0  # mm
_ALONG_AXES = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)

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
"""Group, beginning of the creator's name as in DCMTK's and pydicom's dictionaries, whose it is,
and what to do."""


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
    slices, volumes = _private_number(file.header, 0x30011001), _volumes(file)
    if slices is None or slices != int(slices) or slices < 2:
        raise VolumeError(
            f"{file.path}: is a Cartesian export of Philips that does not say how many slices it "
            f"has; {_QLAB} again"
        )
    header = copy.copy(file.header)
    header.NumberOfFrames = int(min(volumes * slices, 1 << 30))
    return DicomFile(file.path, header, file.syntax, file.little_endian, file.pixels, file.inflated)


def vendor_planes(file: DicomFile, frames: int) -> tuple[list[Plane], list[float]] | None:
    """The places of images that a maker states in a way of its own, and their times in s.

    Args:
        file: as `one_image_after_another` returns it.
        frames: how many images it has.
    """
    header = file.header
    if is_cartesian(file):
        x, y = number(header, "PhysicalDeltaX"), number(header, "PhysicalDeltaY")
        z = _private_number(header, 0x30011003)
        slices = _private_number(header, 0x30011001)
        if not (x and y and z and slices):
            return None
        step = (number(header, "FrameTime") or 1000.0) * 1e-3  # s
        grid = _stack(
            (x * _CENTIMETRES, y * _CENTIMETRES, z * _CENTIMETRES), int(slices), centred=0
        )
        return grid * (frames // int(slices)), [step * (n // int(slices)) for n in range(frames)]
    tag = private(header, 0x200D, "Philips US Imaging DD 036", 0x03)
    spacing = numbers(header, tag, 3) if tag is not None else None
    if spacing and frames > 1:
        return _stack(spacing, frames, centred=0), [0.0] * frames
    if text(header, "Manufacturer") == "Eigen" and (
        text(header, "ManufacturerModelName") == "Artemis" and frames > 1
    ):
        edge = (number(header, "PixelAspectRatio") or 0.0) / 1000
        size = (whole(header, "Columns") or 0, whole(header, "Rows") or 0)
        return _stack((edge, edge, edge), frames, centred=1, size=size), [0.0] * frames
    return None


def hidden_volume(file: DicomFile) -> str:
    """What to do about a volume that is there, but in a form only its maker knows; or nothing."""
    for group, creator, maker, remedy in _HIDDEN:
        for block in range(0x10, 0x100):
            if text(file.header, (group << 16) | block).startswith(creator):
                return f"it has private data of {maker}, where a volume may be: {remedy}"
    return ""


def _stack(
    spacing: Sequence[float], count: int, *, centred: int, size: tuple[int, int] = (1, 1)
) -> list[Plane]:
    """Images one behind the other along the grid's own axes, from 0 or about it; spacing x y z."""
    x, y, z = spacing
    corner = [-centred * (n - 1) / 2 * s for n, s in zip((*size, count), spacing, strict=True)]
    return [
        Plane((corner[0], corner[1], corner[2] + n * z), _ALONG_AXES, (y, x)) for n in range(count)
    ]


def _volumes(file: DicomFile) -> int:
    return max(whole(file.header, "NumberOfFrames") or 1, 1)


def _private_number(header: Any, tag: int) -> float | None:
    """A number whose type the file does not say: as text, whole, or in double precision."""
    found = value(header, tag)
    if isinstance(found, bytes):
        try:
            form = {2: "<H", 4: "<I", 8: "<d"}.get(len(found))
            made = float(struct.unpack(form, found)[0] if form else found.decode("ascii"))
        except (ValueError, struct.error):
            return None
        return made if math.isfinite(made) else None
    return number(header, tag)
