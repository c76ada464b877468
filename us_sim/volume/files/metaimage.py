"""Headers of MetaImage files: their fields, and what they say of the voxels.

>>> import pathlib, tempfile
>>> from us_sim.volume.files.metaimage import metaimage_header, metaimage_voxels
>>> header = "ObjectType = Image\\nNDims = 3\\nDimSize = 4 5 6\\nElementType = MET_SHORT\\n"
>>> with tempfile.TemporaryDirectory() as folder:
...     path = pathlib.Path(folder, "volume.mha")
...     _ = path.write_bytes(f"{header}ElementDataFile = LOCAL\\n".encode() + bytes(240))
...     voxels = metaimage_voxels(path, *metaimage_header(path))
>>> voxels.size, voxels.value, voxels.start
((4, 5, 6), 2, 93)
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping
from pathlib import Path

from us_sim.errors import VolumeError
from us_sim.volume.files.stored_voxels import StoredVoxels

__all__ = ["metaimage_header", "metaimage_voxels"]

_LARGEST_HEADER = 1 << 26
"""Bytes; an hour of tracked frames takes less."""

_LONGEST_LINE = 1 << 16

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

_VECTORS = ("ElementSpacing", "ElementSize", "Offset", "Position", "Origin", "CenterOfRotation")
_MATRICES = ("TransformMatrix", "Rotation", "Orientation")
"""Fields of numbers; where one is none, MetaIO takes 0 or what it has read so far."""


def metaimage_header(path: Path) -> tuple[dict[str, str], int]:
    """The fields of a MetaImage header, and the bytes it takes; ElementDataFile ends it.

    Raises:
        VolumeError: it does not end within 64 MiB.
    """
    fields: dict[str, str] = {}
    with path.open("rb") as file:
        while line := file.readline(_LONGEST_LINE):
            key, _, value = line.decode("latin-1").partition("=")
            fields[key.strip()] = value.strip()
            if key.strip() == "ElementDataFile":
                break
            if file.tell() > _LARGEST_HEADER:
                raise VolumeError(
                    f"{path}: its header does not end within {_LARGEST_HEADER >> 20} MiB, so it "
                    f"is no MetaImage that can be read; export it again"
                )
        return fields, file.tell()


def metaimage_voxels(path: Path, fields: Mapping[str, str], header_bytes: int) -> StoredVoxels:
    """What a MetaImage header says of its voxels.

    Raises:
        VolumeError: a field is missing or not made of the numbers that belong there, the data file
            is missing, or the voxels are stored in a way that cannot be checked.
    """
    for key in ("NDims", "DimSize", "ElementType", "ElementDataFile"):
        if key not in fields:
            raise VolumeError(
                f"{path}: cannot be read as an image: its header has no {key}; give an MHA, NRRD "
                f"or NIfTI volume"
            )
    size = _whole_numbers(path, fields, "DimSize")
    channels = 1
    if "ElementNumberOfChannels" in fields:
        (channels,) = _whole_numbers(path, fields, "ElementNumberOfChannels", 1)
    (dimension,) = _whole_numbers(path, fields, "NDims", 1)
    if dimension != len(size):
        raise VolumeError(
            f"{path}: its DimSize is {fields['DimSize']!r} where NDims says {dimension} numbers; "
            f"export it again"
        )
    for keys, count in ((_VECTORS, dimension), (_MATRICES, dimension**2)):
        for key in keys:
            if key in fields and not _are_numbers(fields[key], count):
                raise VolumeError(
                    f"{path}: its {key} is {fields[key][:80]!r} where {count} finite numbers "
                    f"belong; every one must be a number: export it again"
                )
    element = fields["ElementType"]
    if element not in _ELEMENT_BYTES:
        raise VolumeError(
            f"{path}: its ElementType is {element[:80]!r}; save it with one of "
            f"{', '.join(_ELEMENT_BYTES)}"
        )
    name = fields["ElementDataFile"]
    if "BinaryData" in fields and not _is_true(fields["BinaryData"]):
        raise VolumeError(f"{path}: holds its voxels as text; save it in binary form")
    if name.upper().startswith("LIST") or "%" in name:
        raise VolumeError(f"{path}: keeps its voxels in several files; save it as one .mha file")
    if fields.get("HeaderSize", "0") != "0":
        raise VolumeError(f"{path}: has a HeaderSize, which is not read; save it as one .mha file")
    is_local = name.upper() == "LOCAL"
    data = path if is_local else path.parent / name
    if not os.path.isfile(data):
        raise VolumeError(f"{path}: names the data file {name}, which is not there")
    start = header_bytes if is_local else 0
    packed = _is_true(fields.get("CompressedData", "False"))
    if packed and "CompressedDataSize" in fields:
        (said,) = _whole_numbers(path, fields, "CompressedDataSize", 1)
        there = data.stat().st_size - start
        if said != there:
            raise VolumeError(
                f"{path}: holds {there} bytes of image data where its header says {said} "
                f"compressed ones; copy or export it again"
            )
    if channels > 1:
        size = (channels, *size)
    return StoredVoxels(size, _ELEMENT_BYTES[element], data, path, start, packed=packed)


def _whole_numbers(
    path: Path, fields: Mapping[str, str], key: str, count: int | None = None
) -> tuple[int, ...]:
    """The whole numbers of a field; ``count`` of them where it is given."""
    words = fields[key].split()
    if not words or len(words) != (count or len(words)) or not all(map(_is_whole, words)):
        raise VolumeError(
            f"{path}: its {key} is {fields[key][:80]!r} where whole numbers above zero belong; "
            f"export it again"
        )
    return tuple(map(int, words))


def _is_whole(word: str) -> bool:
    # int() would also take 1_000 and the digits of other scripts.
    return re.fullmatch(r"0*[1-9][0-9]{0,17}", word) is not None


def _are_numbers(text: str, count: int) -> bool:
    words = text.split()
    try:
        return len(words) == count and all(math.isfinite(float(word)) for word in words)
    except ValueError:
        return False


def _is_true(text: str) -> bool:
    """As MetaIO reads it."""
    return text[:1] in ("T", "t", "1")
