"""What the header of a NIfTI file says of its voxels (nifti.nimh.nih.gov, nifti1.h and nifti2.h).

>>> import pathlib, tempfile, SimpleITK
>>> from us_sim.volume.files.nifti import nifti_voxels
>>> with tempfile.TemporaryDirectory() as folder:
...     path = pathlib.Path(folder, "volume.nii.gz")
...     SimpleITK.WriteImage(SimpleITK.Image([4, 5, 6], SimpleITK.sitkInt16), str(path))
...     voxels = nifti_voxels(path)
>>> voxels.size, voxels.value, voxels.skip, voxels.packed
((4, 5, 6), 2, 352, True)
"""

from __future__ import annotations

import math
import struct
import zlib
from pathlib import Path

from us_sim.errors import VolumeError
from us_sim.volume.files.stored_voxels import StoredVoxels

__all__ = ["nifti_voxels"]

_BYTES = {2: 1, 4: 2, 8: 4, 16: 4, 64: 8, 256: 1, 512: 2, 768: 4, 1024: 8, 1280: 8}
"""Of each data type of one number."""

_COLOURS = {32: 8, 128: 3, 1536: 16, 1792: 16, 2048: 32, 2304: 4}
"""Bytes of types that ITK reads as several numbers a voxel, or not at all."""


def nifti_voxels(path: Path) -> StoredVoxels:
    """What a NIfTI header says of its voxels; the file may be packed by gzip.

    Raises:
        VolumeError: it is no such header, or the compression is broken.
    """
    with path.open("rb") as file:
        start = file.read(4096)
    packed = start.startswith(b"\x1f\x8b")
    if packed:
        try:
            start = zlib.decompressobj(16 + zlib.MAX_WBITS).decompress(start, 1024)
        except zlib.error as error:
            raise VolumeError(
                f"{path}: its compression is broken or cut short; copy it again"
            ) from error
    for order in "<>":
        found = _fields(start, order)
        if found is not None:
            lengths, kind, offset = found
            break
    else:
        raise VolumeError(
            f"{path}: cannot be read as an image: it does not begin as NIfTI does; give an MHA, "
            f"NRRD or NIfTI volume"
        )
    size = lengths[1 : 1 + lengths[0]] if 1 <= lengths[0] <= 7 else ()
    value = (_BYTES | _COLOURS).get(kind)
    if not size or min(size) < 1 or value is None or not 348 <= offset < 1 << 31:
        raise VolumeError(
            f"{path}: cannot be read as an image: its header says {lengths[0]} axes of "
            f"{', '.join(map(str, lengths[1:]))} voxels of data type {kind} from byte {offset:g}; "
            f"export it again"
        )
    return StoredVoxels(tuple(size), value, path, path, 0, int(offset), packed)


def _fields(start: bytes, order: str) -> tuple[tuple[int, ...], int, float] | None:
    """Axes and their lengths, the data type, and the byte of the first voxel."""
    if len(start) < 540:
        start = start.ljust(540, b"\0")
    (first,) = struct.unpack_from(f"{order}i", start)
    if first == 348 and start[344:347] == b"n+1":
        lengths = struct.unpack_from(f"{order}8h", start, 40)
        (kind,) = struct.unpack_from(f"{order}h", start, 70)
        (offset,) = struct.unpack_from(f"{order}f", start, 108)
        return lengths, kind, offset if math.isfinite(offset) else 0.0
    if first == 540 and start[4:7] == b"n+2":
        lengths = struct.unpack_from(f"{order}8q", start, 16)
        (kind,) = struct.unpack_from(f"{order}h", start, 12)
        (offset,) = struct.unpack_from(f"{order}q", start, 168)
        return lengths, kind, float(offset)
    return None
