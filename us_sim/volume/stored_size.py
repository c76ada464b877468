"""A check that an image file holds the bytes that its header promises: MetaImage and NIfTI.

ITK fills what is missing from a cut NIfTI file with zeros and ignores what is too much in a
MetaImage file, so a broken copy would pass for a dark image. (NRRD's reader does notice.)

>>> import tempfile, pathlib
>>> from us_sim.volume.stored_size import check_stored_size
>>> header = "ObjectType = Image\\nNDims = 3\\nDimSize = 4 5 6\\nElementType = MET_SHORT\\n"
>>> with tempfile.TemporaryDirectory() as folder:
...     path = pathlib.Path(folder, "cut.mha")
...     _ = path.write_bytes(f"{header}ElementDataFile = LOCAL\\n".encode() + bytes(100))
...     check_stored_size(path)  # doctest: +ELLIPSIS
Traceback (most recent call last):
us_sim.errors.VolumeError: ...cut.mha: holds 100 bytes of image data where its header says 240; ...
"""

from __future__ import annotations

import gzip
import math
import struct
import zlib
from pathlib import Path
from typing import BinaryIO

from us_sim.errors import VolumeError

__all__ = ["check_stored_size", "metaimage_header"]

_ELEMENT_BYTES = {
    "MET_CHAR": 1,
    "MET_UCHAR": 1,
    "MET_SHORT": 2,
    "MET_USHORT": 2,
    "MET_INT": 4,
    "MET_UINT": 4,
    "MET_LONG": 4,
    "MET_ULONG": 4,
    "MET_LONG_LONG": 8,
    "MET_ULONG_LONG": 8,
    "MET_FLOAT": 4,
    "MET_DOUBLE": 8,
}
"""MetaImage's element types and their bytes (MetaIO, metaTypes.h)."""

_CHUNK = 1 << 20


def check_stored_size(path: Path) -> None:
    """Compare the bytes of image data in a MetaImage or NIfTI file with its header.

    Files of other formats, and headers that this does not understand, pass: their reader judges.

    Raises:
        VolumeError: the file holds fewer or more bytes, its data file is missing, or its
            compression is broken.
    """
    name = path.name.lower()
    if name.endswith((".mha", ".mhd")):
        _check_metaimage(path)
    elif name.endswith(".nii"):
        with path.open("rb") as file:
            _check_nifti(path, file)
    elif name.endswith(".nii.gz"):
        try:
            with gzip.open(path, "rb") as file:
                _check_nifti(path, file)
        except (EOFError, gzip.BadGzipFile, zlib.error) as error:
            raise VolumeError(
                f"{path}: its gzip compression is broken or cut short; copy it again"
            ) from error


def _check_metaimage(path: Path) -> None:
    fields, header_bytes = metaimage_header(path)
    try:
        size = [int(length) for length in fields["DimSize"].split()]
        element = _ELEMENT_BYTES[fields["ElementType"]]
        channels = int(fields.get("ElementNumberOfChannels", "1"))
        data_file = fields["ElementDataFile"]
        skipped = int(fields.get("HeaderSize", "0"))
        compressed = fields.get("CompressedData", "False").lower() == "true"
        expected = math.prod(size) * element * channels
        if compressed:
            expected = int(fields["CompressedDataSize"])
    except (KeyError, ValueError):
        return
    if fields.get("BinaryData", "True").lower() == "false" or skipped != 0:
        return
    if data_file.upper() == "LOCAL":
        stored = path.stat().st_size - header_bytes
    elif data_file.upper().startswith("LIST") or "%" in data_file:
        return
    elif (path.parent / data_file).is_file():
        stored = (path.parent / data_file).stat().st_size
    else:
        raise VolumeError(f"{path}: names the data file {data_file}, which is not there")
    _compare(path, stored, expected)


def metaimage_header(path: Path) -> tuple[dict[str, str], int]:
    """The fields of a MetaImage header, and the bytes it takes; ElementDataFile ends it."""
    fields: dict[str, str] = {}
    with path.open("rb") as file:
        while line := file.readline(4096):
            key, _, value = line.decode("latin-1").partition("=")
            fields[key.strip()] = value.strip()
            if key.strip() == "ElementDataFile":
                break
        return fields, file.tell()


def _check_nifti(path: Path, file: BinaryIO | gzip.GzipFile) -> None:
    header = file.read(348)
    for order in "<>":
        if len(header) == 348 and struct.unpack_from(f"{order}i", header)[0] == 348:
            # NIfTI-1: dim at byte 40, bitpix at 72, vox_offset at 108, magic at 344.
            lengths = struct.unpack_from(f"{order}8h", header, 40)
            (bits,) = struct.unpack_from(f"{order}h", header, 72)
            offset = int(struct.unpack_from(f"{order}f", header, 108)[0])
            if header[344:347] == b"n+1" and 1 <= lengths[0] <= 7:
                break
        if len(header) == 348 and struct.unpack_from(f"{order}i", header)[0] == 540:
            # NIfTI-2: bitpix at byte 14, dim at 16, vox_offset at 168.
            (bits,) = struct.unpack_from(f"{order}h", header, 14)
            lengths = struct.unpack_from(f"{order}8q", header, 16)
            (offset,) = struct.unpack_from(f"{order}q", header, 168)
            if 1 <= lengths[0] <= 7:
                break
    else:
        return
    total = len(header)
    while chunk := file.read(_CHUNK):
        total += len(chunk)
    voxels = math.prod(lengths[1 : lengths[0] + 1])
    _compare(path, total - offset, voxels * bits // 8)


def _compare(path: Path, stored: int, expected: int) -> None:
    if stored != expected:
        raise VolumeError(
            f"{path}: holds {max(stored, 0)} bytes of image data where its header says {expected}; "
            f"copy or export it again"
        )
