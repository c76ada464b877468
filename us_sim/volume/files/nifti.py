"""Headers of NIfTI files of both versions, in one file or in two (nifti.nimh.nih.gov)."""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.errors import VolumeError
from us_sim.volume.files.placement import checked_placement
from us_sim.volume.files.stored_image import StoredImage, StoredVoxels

_TYPES = {2: "u1", 4: "i2", 8: "i4", 16: "f4", 64: "f8", 256: "i1", 512: "u2", 768: "u4"}
_TYPES |= {1024: "i8", 1280: "u8"}
_COLOURS = {128: 3, 2304: 4}
"""Bytes of a voxel's colour."""

_VERSION_1 = {
    "data_type": (4, "10s"),
    "db_name": (14, "18s"),
    "dim": (40, "8h"),
    "datatype": (70, "h"),
    "pixdim": (76, "8f"),
    "vox_offset": (108, "f"),
    "scaling": (112, "2f"),
    "xyzt_units": (123, "B"),
    "descrip": (148, "80s"),
    "aux_file": (228, "24s"),
    "qform_code": (252, "h"),
    "sform_code": (254, "h"),
    "quaternion": (256, "3f"),
    "qoffset": (268, "3f"),
    "srow": (280, "12f"),
    "intent_name": (328, "16s"),
    "extension": (348, "4s"),
}
_VERSION_2 = {
    "dim": (16, "8q"),
    "datatype": (12, "h"),
    "pixdim": (104, "8d"),
    "vox_offset": (168, "q"),
    "scaling": (176, "2d"),
    "xyzt_units": (500, "i"),
    "descrip": (240, "80s"),
    "aux_file": (320, "24s"),
    "qform_code": (344, "i"),
    "sform_code": (348, "i"),
    "quaternion": (352, "3d"),
    "qoffset": (376, "3d"),
    "srow": (400, "12d"),
    "intent_name": (508, "16s"),
    "extension": (540, "4s"),
}
"""First byte and form of each field (nifti1.h, nifti2.h)."""

NIFTI_TEXTS = ("data_type", "db_name", "descrip", "aux_file", "intent_name", "extension")
"""Fields in which anything may be written, of the first version or of both."""
_UNITS = {0: 1.0, 1: 1e3, 2: 1.0, 3: 1e-3}  # mm; 0 is not stated, and millimetres by custom
_TO_LPS = np.diag([-1.0, -1.0, 1.0])  # NIfTI's x goes to the right, its y to the front
_SQUARE = 1e-3  # products of directions that are at right angles


def nifti_image(path: Path, given: ArrayLike | None = None) -> StoredImage:
    """What a NIfTI header says of its image; header and voxels may each be packed by gzip.

    Args:
        path: of the file, or of one of the pair ``.hdr`` and ``.img``.
        given: (3,) mm, the spacing of a file that does not state it.

    Raises:
        VolumeError: it is no such header, or the compression is broken.
    """
    fields = nifti_fields(path)
    lengths, kind, offset = fields["dim"], fields["datatype"], fields["vox_offset"]
    size = lengths[1 : 1 + lengths[0]] if 1 <= lengths[0] <= 7 else ()
    least = 0 if fields["pair"] else 348
    if (
        not size
        or min(size) < 1
        or kind not in _TYPES | _COLOURS
        or not (math.isfinite(offset) and least <= offset < 1 << 31)
    ):
        raise VolumeError(
            f"{path}: cannot be read as an image: its header says {lengths[0]} axes of "
            f"{', '.join(map(str, lengths[1:]))} voxels of data type {kind} from byte {offset:g}; "
            f"export it again"
        )
    while len(size) > 3 and size[-1] == 1:
        size = size[:-1]
    file = _beside(path, ".img") if fields["pair"] else path
    with file.open("rb") as data:
        packed = data.read(2) == b"\x1f\x8b"
    components = _COLOURS.get(kind, 1)
    slope, offset_of_values = fields["scaling"]
    usable = math.isfinite(slope) and math.isfinite(offset_of_values) and slope != 0.0
    return StoredImage(
        StoredVoxels(
            (components, *size) if components > 1 else tuple(size),
            np.dtype(f"{fields['order']}{_TYPES.get(kind, 'u1')}"),
            file,
            path,
            skip=int(offset),
            encoding="packed" if packed else "raw",
        ),
        components,
        placement=lambda: _placement(path, fields, given),
        scaling=(slope, offset_of_values) if usable else (1.0, 0.0),
    )


def nifti_fields(path: Path) -> dict[str, Any]:
    """The fields of a header, its byte ``order``, and whether it is one of a ``pair`` of files.

    Raises:
        VolumeError: it is no such header, or the compression is broken.
    """
    file = _beside(path, ".hdr") if ".nii" not in path.name.lower() else path
    with file.open("rb") as opened:
        start = opened.read(4096)
    if start.startswith(b"\x1f\x8b"):
        try:
            start = zlib.decompressobj(16 + zlib.MAX_WBITS).decompress(start, 1024)
        except zlib.error as error:
            raise VolumeError(
                f"{path}: its compression is broken or cut short; copy it again"
            ) from error
    start = start.ljust(1024, b"\0")
    for order in "<>":
        (first,) = struct.unpack_from(f"{order}i", start)
        magic = start[344:347] if first == 348 else start[4:7]
        if first not in (348, 540):
            continue
        if magic not in (b"n+1", b"ni1", b"n+2", b"ni2"):
            break
        layout = _VERSION_1 if first == 348 else _VERSION_2
        found: dict[str, Any] = {"order": order, "pair": magic[1:2] == b"i"}
        for name, (at, form) in layout.items():
            values = struct.unpack_from(f"{order}{form}", start, at)
            found[name] = values if len(values) > 1 else values[0]
        return found
    is_analyze = struct.unpack_from("<i", start)[0] == 348 or start[:4] == b"\0\0\1\x5c"
    if is_analyze:
        raise VolumeError(
            f"{path}: cannot be read as an image: it is of Analyze 7.5, which does not say which "
            f"side is left; save it as NIfTI where that is known"
        )
    raise VolumeError(
        f"{path}: cannot be read as an image: it does not begin as NIfTI does; give an MHA, NRRD "
        f"or NIfTI volume"
    )


def _beside(path: Path, ending: str) -> Path:
    """The other one of a pair of files, or this one; either may be packed."""
    stem = path.name.removesuffix(".gz").removesuffix(".GZ")[:-4]
    for name in (stem + ending, stem + ending.upper()):
        for packed in ("", ".gz"):
            if (file := path.with_name(name + packed)).is_file():
                return file
    raise VolumeError(f"{path}: belongs to {stem}{ending}, which is not there")


def _placement(
    path: Path, fields: Mapping[str, Any], given: ArrayLike | None
) -> NDArray[np.float64]:
    """(4, 4) m: by the affine matrix, by the quaternion, or by the spacing alone.

    A matrix whose axes are not at right angles gives way to a quaternion, as in ITK.
    """
    unit = _UNITS.get(fields["xyzt_units"] & 7, 1.0)
    rows = np.array(fields["srow"], np.float64).reshape(3, 4)
    spacing = np.array(fields["pixdim"][1:4], np.float64)
    stated = np.isfinite(spacing).all() and (spacing != 0.0).all()
    lengths = np.linalg.norm(rows[:, :3], axis=0)
    with np.errstate(all="ignore"):
        along = rows[:, :3] / lengths
        is_square = np.abs(along.T @ along - np.eye(3)).max() < _SQUARE
    if fields["sform_code"] > 0 and (is_square or fields["qform_code"] <= 0):
        origin, spacing, stated = rows[:, 3], lengths, True
    elif fields["qform_code"] > 0:
        along, origin = _turned(fields), np.array(fields["qoffset"], np.float64)
        spacing = np.abs(spacing)
    else:
        along, origin, spacing = _TO_LPS, np.zeros(3), np.abs(spacing)
    return checked_placement(
        path, unit * spacing if stated else None, _TO_LPS @ along, unit * _TO_LPS @ origin, given
    )


def _turned(fields: Mapping[str, Any]) -> NDArray[np.float64]:
    """(3, 3) directions of the axes by the quaternion (nifti1.h, method 2)."""
    b, c, d = fields["quaternion"]
    length = math.sqrt(min(b * b + c * c + d * d, 1e30))
    if length > 1.0:
        a, b, c, d = 0.0, b / length, c / length, d / length
    else:
        a = math.sqrt(max(0.0, 1.0 - length * length))
    mirror = -1.0 if fields["pixdim"][0] < 0.0 else 1.0
    return np.array(
        [
            [a * a + b * b - c * c - d * d, 2 * (b * c - a * d), 2 * (b * d + a * c) * mirror],
            [2 * (b * c + a * d), a * a + c * c - b * b - d * d, 2 * (c * d - a * b) * mirror],
            [2 * (b * d - a * c), 2 * (c * d + a * b), (a * a + d * d - b * b - c * c) * mirror],
        ]
    )
