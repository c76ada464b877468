"""What the header of an NRRD file says of its voxels (teem.sourceforge.net/nrrd/format.html).

>>> import pathlib, tempfile
>>> from us_sim.volume.files.nrrd import nrrd_voxels
>>> header = b"NRRD0004\\ntype: short\\ndimension: 3\\nsizes: 4 5 6\\nencoding: raw\\n\\n"
>>> with tempfile.TemporaryDirectory() as folder:
...     path = pathlib.Path(folder, "volume.nrrd")
...     _ = path.write_bytes(header + bytes(240))
...     voxels = nrrd_voxels(path)
>>> voxels.size, voxels.value, voxels.start
((4, 5, 6), 2, 62)
"""

from __future__ import annotations

import math
import os
import re
from pathlib import Path

from us_sim.errors import VolumeError
from us_sim.volume.files.stored_voxels import StoredVoxels

__all__ = ["nrrd_header", "nrrd_voxels"]

_LARGEST_HEADER = 1 << 26
"""Bytes; an hour of tracked frames takes less."""

_LONGEST_LINE = 1 << 16

_LONGEST_FIELD = 1000
"""Characters: what ITK's reader says of a line that it cannot use is written to a place of about
two thousand."""

_TYPES = {
    1: "signed char|int8|int8_t|uchar|unsigned char|uint8|uint8_t",
    2: "short|short int|signed short|signed short int|int16|int16_t"
    "|ushort|unsigned short|unsigned short int|uint16|uint16_t",
    4: "int|signed int|int32|int32_t|uint|unsigned int|uint32|uint32_t|float",
    8: "longlong|long long|long long int|signed long long|signed long long int|int64|int64_t"
    "|ulonglong|unsigned long long|unsigned long long int|uint64|uint64_t|double",
}
_BYTES = {name: size for size, names in _TYPES.items() for name in names.split("|")}

_PER_AXIS = {
    *("space directions", "spacings", "thicknesses", "axis mins", "axismins", "axis maxs"),
    *("axismaxs", "centers", "centerings", "kinds", "labels", "units"),
}

_PACKED = {"raw": False, "gzip": True, "gz": True}


def nrrd_voxels(path: Path) -> StoredVoxels:
    """What an NRRD header says of its voxels.

    Raises:
        VolumeError: it is no such header, its data file is missing, or the voxels are stored in a
            way that cannot be checked.
    """
    fields, _, header_bytes = nrrd_header(path)
    size = fields.get("sizes", "").split()
    dimension = fields.get("dimension", "")
    if dimension != str(len(size)) or not all(re.fullmatch(r"[1-9][0-9]{0,17}", n) for n in size):
        raise VolumeError(
            f"{path}: cannot be read as an image: its sizes are {' '.join(size)[:80]!r} and its "
            f"dimension {dimension[:80]!r} where as many whole numbers above zero belong"
        )
    _check_axes(path, fields, len(size))
    kind, encoding = fields.get("type", "").lower(), fields.get("encoding", "").lower()
    if kind not in _BYTES or encoding not in _PACKED:
        raise VolumeError(
            f"{path}: holds voxels of type {kind[:80]!r} in the encoding {encoding[:80]!r}; save "
            f"it as whole or floating-point numbers, raw or gzip"
        )
    for skipped in ("line skip", "lineskip", "byte skip", "byteskip"):
        if fields.get(skipped, "0") != "0":
            raise VolumeError(f"{path}: has a {skipped}, which is not read; save it as one .nrrd")
    name = fields.get("data file") or fields.get("datafile")
    if name is None:
        file, start = path, header_bytes
    else:
        file, start = path.parent / name, 0
        if name.startswith("LIST") or "%" in name:
            raise VolumeError(f"{path}: keeps its voxels in several files; save it as one .nrrd")
        if not os.path.isfile(file):
            raise VolumeError(f"{path}: names the data file {name}, which is not there")
    return StoredVoxels(
        tuple(map(int, size)), _BYTES[kind], file, path, start, packed=_PACKED[encoding]
    )


def _check_axes(path: Path, fields: dict[str, str], dimension: int) -> None:
    """Refuse fields of more or fewer axes; ITK's reader writes beyond its memory for them."""
    pieces = {key: re.findall(r"\([^()]*\)|\"[^\"]*\"|[^\s()]+", fields[key]) for key in fields}
    for key, found in pieces.items():
        if key in _PER_AXIS and len(found) != dimension:
            raise VolumeError(
                f"{path}: its {key} has {len(found)} entries where the image has {dimension} axes; "
                f"export it again"
            )
    vectors = [*pieces.get("space directions", ()), *pieces.get("space origin", ())]
    vectors += pieces.get("measurement frame", ())
    if not all(vector == "none" or _is_vector(vector) for vector in vectors) or (
        len(pieces.get("space origin", [""])) != 1
        or len(pieces.get("measurement frame", "xyz")) != 3
        or len(pieces.get("space units", "xyz")) > 3
    ):
        raise VolumeError(
            f"{path}: its space directions, origin or units are not made of vectors of three "
            f"finite numbers; export it again"
        )


def _is_vector(text: str) -> bool:
    if not (text.startswith("(") and text.endswith(")")):
        return False
    words = text[1:-1].split(",")
    try:
        return len(words) == 3 and all(math.isfinite(float(word)) for word in words)
    except ValueError:
        return False


def nrrd_header(path: Path) -> tuple[dict[str, str], dict[str, str], int]:
    """The fields of a header, its further keys and values, and the bytes up to its voxels.

    The fields' names are in lower case; keys are as they were written (``key:=value``).

    Raises:
        VolumeError: it is no NRRD header, has a field twice or a line too long, or does not end.
    """
    fields: dict[str, str] = {}
    pairs: dict[str, str] = {}
    with path.open("rb") as file:
        if not file.readline(64).startswith(b"NRRD"):
            raise VolumeError(
                f"{path}: cannot be read as an image: it does not begin as NRRD does; give an "
                f"MHA, NRRD, NIfTI or DICOM volume"
            )
        while line := file.readline(_LONGEST_LINE).decode("latin-1").rstrip("\r\n"):
            if file.tell() > _LARGEST_HEADER:
                raise VolumeError(f"{path}: cannot be read as an image: its header does not end")
            if line.startswith("#"):
                continue
            key, colon, value = line.partition(":")
            if value.startswith("="):
                pairs[key.strip()] = value[1:].strip()
                continue
            if len(line) > _LONGEST_FIELD:
                raise VolumeError(
                    f"{path}: its header has a line of {len(line)} characters, {line[:30]!r} and "
                    f"on; export it again"
                )
            key = key.strip().lower()
            if colon and value.startswith(" "):
                if key in fields:
                    raise VolumeError(f"{path}: its header has {key!r} twice; export it again")
                fields[key] = value.strip()
        return fields, pairs, file.tell()
