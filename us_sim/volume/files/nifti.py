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
_COLOURS = {128: 3, 2304: 4}  # bytes of a voxel's colour

_LAYOUT = {
    "dim": ("8h", 40, "8q", 16),
    "datatype": ("h", 70, "h", 12),
    "pixdim": ("8f", 76, "8d", 104),
    "vox_offset": ("f", 108, "q", 168),
    "scaling": ("2f", 112, "2d", 176),
    "xyzt_units": ("B", 123, "i", 500),
    "qform_code": ("h", 252, "i", 344),
    "sform_code": ("h", 254, "i", 348),
    "quaternion": ("3f", 256, "3d", 352),
    "qoffset": ("3f", 268, "3d", 376),
    "srow": ("12f", 280, "12d", 400),
    "descrip": ("80s", 148, "80s", 240),
    "aux_file": ("24s", 228, "24s", 320),
    "intent_name": ("16s", 328, "16s", 508),
    "extension": ("4s", 348, "4s", 540),
    "data_type": ("10s", 4, "", 0),
    "db_name": ("18s", 14, "", 0),
}
"""Form and first byte of each field in version 1 (nifti1.h), then in version 2 (nifti2.h)."""

NIFTI_TEXTS = ("data_type", "db_name", "descrip", "aux_file", "intent_name", "extension")
"""Fields in which anything may be written, of the first version or of both."""

_TO_LPS = np.diag([-1.0, -1.0, 1.0])  # NIfTI's x goes to the right, its y to the front


def nifti_image(path: Path, given: ArrayLike | None = None) -> StoredImage:
    """The image that a NIfTI header describes; header and voxels may each be packed by gzip.

    The file may be one of the pair ``.hdr`` and ``.img``. ``given`` is the spacing, (3,) mm, of a
    file that does not state it.

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
    file = _of_pair(path, ".img") if fields["pair"] else path
    with file.open("rb") as data:
        packed = data.read(2) == b"\x1f\x8b"
    components = _COLOURS.get(kind, 1)
    voxels = StoredVoxels(
        (components, *size) if components > 1 else tuple(size),
        np.dtype(f"{fields['order']}{_TYPES.get(kind, 'u1')}"),
        file,
        path,
        skip=int(offset),
        encoding="packed" if packed else "raw",
    )
    slope, intercept = fields["scaling"]
    usable = math.isfinite(slope) and math.isfinite(intercept) and slope != 0.0
    scaling = (slope, intercept) if usable else (1.0, 0.0)
    return StoredImage(voxels, components, lambda: _placement(path, fields, given), scaling)


def nifti_fields(path: Path) -> dict[str, Any]:
    """The fields of a header, its byte ``order``, and whether it is one of a ``pair`` of files.

    Raises:
        VolumeError: it is no such header, or the compression is broken.
    """
    file = _of_pair(path, ".hdr") if ".nii" not in path.name.lower() else path
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
        if first not in (348, 540):
            continue
        magic = start[344:347] if first == 348 else start[4:7]
        if magic not in (b"n+1", b"ni1", b"n+2", b"ni2"):
            break
        found: dict[str, Any] = {"order": order, "pair": magic[1:2] == b"i"}
        for name, layout in _LAYOUT.items():
            form, at = layout[:2] if first == 348 else layout[2:]
            if form:
                values = struct.unpack_from(f"{order}{form}", start, at)
                found[name] = values if len(values) > 1 else values[0]
        return found
    if struct.unpack_from("<i", start)[0] == 348 or start[:4] == b"\0\0\1\x5c":
        raise VolumeError(
            f"{path}: cannot be read as an image: it is of Analyze 7.5, which does not say which "
            f"side is left; save it as NIfTI where that is known"
        )
    raise VolumeError(
        f"{path}: cannot be read as an image: it does not begin as NIfTI does; give an MHA, NRRD "
        f"or NIfTI volume"
    )


def _of_pair(path: Path, ending: str) -> Path:
    """The file of a pair that has an ending; either may be packed."""
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
    # mm of metres, millimetres and micrometres; 0 is not stated, and millimetres by custom
    unit = {1: 1e3, 2: 1.0, 3: 1e-3}.get(fields["xyzt_units"] & 7, 1.0)
    rows = np.array(fields["srow"], np.float64).reshape(3, 4)
    spacing = np.array(fields["pixdim"][1:4], np.float64)
    stated = np.isfinite(spacing).all() and (spacing != 0.0).all()
    lengths = np.linalg.norm(rows[:, :3], axis=0)
    with np.errstate(all="ignore"):
        along = rows[:, :3] / lengths
        is_square = np.abs(along.T @ along - np.eye(3)).max() < 1e-3
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
