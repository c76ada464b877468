"""Headers of NRRD files (teem.sourceforge.net/nrrd/format.html), read without trust in them."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.errors import VolumeError
from us_sim.volume.files.placement import checked_placement, millimetres
from us_sim.volume.files.stored_image import Encoding, StoredImage, StoredVoxels

_LONGEST_LINE = 1 << 16
_TYPES = {
    "i1": "signed char|int8|int8_t",
    "u1": "uchar|unsigned char|uint8|uint8_t",
    "i2": "short|short int|signed short|signed short int|int16|int16_t",
    "u2": "ushort|unsigned short|unsigned short int|uint16|uint16_t",
    "i4": "int|signed int|int32|int32_t",
    "u4": "uint|unsigned int|uint32|uint32_t",
    "i8": "longlong|long long|long long int|signed long long|signed long long int|int64|int64_t",
    "u8": "ulonglong|unsigned long long|unsigned long long int|uint64|uint64_t",
    "f4": "float",
    "f8": "double",
}
_TYPE = {name: kind for kind, names in _TYPES.items() for name in names.split("|")}
_ENCODINGS: dict[str, Encoding] = {"raw": "raw", "gzip": "packed", "gz": "packed"}
_ENCODINGS |= {"bzip2": "bzip2", "bz2": "bzip2", "ascii": "text", "text": "text", "txt": "text"}
_TO_LPS = {
    "left-posterior-superior": (1, 1, 1),
    "right-anterior-superior": (-1, -1, 1),
    "left-anterior-superior": (1, -1, 1),
}
_TO_LPS |= {"lps": (1, 1, 1), "ras": (-1, -1, 1), "las": (1, -1, 1)}
"""Signs that turn a space's axes to left-posterior-superior; others are taken for that."""


def nrrd_header(path: Path) -> tuple[dict[str, str], dict[str, str], int]:
    """The fields of a header, its further keys and values, and the bytes up to its voxels.

    The fields' names are in lower case; keys are as they were written (``key:=value``).

    Raises:
        VolumeError: it is no NRRD header, has a field twice, or does not end.
    """
    fields: dict[str, str] = {}
    pairs: dict[str, str] = {}
    with path.open("rb") as file:
        if not file.readline(64).startswith(b"NRRD"):
            raise VolumeError(
                f"{path}: cannot be read as an image: it does not begin as NRRD does; give an "
                f"MHA, NRRD, NIfTI or DICOM volume"
            )
        while line := _text(file.readline(_LONGEST_LINE)).rstrip("\r\n"):
            if file.tell() > 1 << 26:  # an hour of tracked frames takes less
                raise VolumeError(f"{path}: cannot be read as an image: its header does not end")
            if line.startswith("#"):
                continue
            key, colon, value = line.partition(":")
            if value.startswith("="):
                pairs[key.strip()] = value[1:].strip()
                continue
            key = key.strip().lower()
            if colon and value.startswith(" "):
                if key in fields:
                    raise VolumeError(f"{path}: its header has {key!r} twice; export it again")
                fields[key] = value.strip()
        return fields, pairs, file.tell()


def _text(line: bytes) -> str:
    """A line, which most programs write as UTF-8."""
    try:
        return line.decode("utf-8")
    except UnicodeDecodeError:
        return line.decode("latin-1")


def nrrd_voxels(path: Path) -> StoredVoxels:
    """The numbers that an NRRD header describes.

    Raises:
        VolumeError: it is no such header, its data file is missing, or they are stored in a way
            that is not read.
    """
    fields, _, header_bytes = nrrd_header(path)
    size = fields.get("sizes", "").split()
    dimension = fields.get("dimension", "")
    if dimension != str(len(size)) or not all(re.fullmatch(r"[1-9][0-9]{0,17}", n) for n in size):
        raise VolumeError(
            f"{path}: cannot be read as an image: its sizes are {' '.join(size)[:80]!r} and its "
            f"dimension {dimension[:80]!r} where as many whole numbers above zero belong"
        )
    kind, encoding = fields.get("type", "").lower(), fields.get("encoding", "").lower()
    if kind not in _TYPE or encoding not in _ENCODINGS:
        raise VolumeError(
            f"{path}: holds voxels of type {kind[:80]!r} in the encoding {encoding[:80]!r}; save "
            f"it as whole or floating-point numbers: raw, gzip, bzip2 or ascii"
        )
    name = fields.get("data file") or fields.get("datafile")
    file, start = path, header_bytes
    if name is not None:
        file, start = path.parent / name, 0
        if name.startswith("LIST") or "%" in name:
            raise VolumeError(f"{path}: keeps its voxels in several files; save it as one .nrrd")
        if not os.path.isfile(file):
            raise VolumeError(f"{path}: names the data file {name}, which is not there")
    lines, skip = (_skipped(path, fields, unit) for unit in ("line", "byte"))
    with file.open("rb") as data:
        data.seek(start)
        for _ in range(lines):
            data.readline(_LONGEST_LINE)
        start = data.tell()
    number = np.dtype(f"{'>' if fields.get('endian', '').lower() == 'big' else '<'}{_TYPE[kind]}")
    shape = tuple(map(int, size))
    voxels = StoredVoxels(shape, number, file, path, start, max(skip, 0), _ENCODINGS[encoding])
    if skip == -1 and encoding == "raw":  # the last bytes of the file
        return replace(voxels, start=max(file.stat().st_size - voxels.expected, start))
    if skip < 0:
        raise VolumeError(f"{path}: its byte skip is {skip}, which goes with raw data only")
    return voxels


def _skipped(path: Path, fields: Mapping[str, str], unit: str) -> int:
    said = fields.get(f"{unit} skip", fields.get(f"{unit}skip", "0"))
    if not re.fullmatch(r"[0-9]{1,9}" if unit == "line" else r"-1|[0-9]{1,9}", said):
        raise VolumeError(f"{path}: its {unit} skip is {said[:80]!r}; export it again")
    return int(said)


def nrrd_image(path: Path, given: ArrayLike | None = None) -> StoredImage:
    """The image that a header describes, whose first axis may be numbers of a voxel and whose last
    one several volumes.

    ``given`` is the spacing, (3,) mm, of a file that does not state it.

    Raises:
        VolumeError: as `nrrd_voxels`, or its axes are no volume's.
    """
    fields, pairs, _ = nrrd_header(path)
    voxels = nrrd_voxels(path)
    axes = _axes_of_space(path, fields, len(voxels.size))
    first, last = (axes[0], axes[-1] + 1) if axes else (0, 0)
    if len(axes) != last - first or len(voxels.size) - last > 1 or first > 1:
        raise VolumeError(
            f"{path}: of its {len(voxels.size)} axes these are of space: "
            f"{', '.join(str(n + 1) for n in axes) or 'none'}; save it with three in a row"
        )
    if last - first != 3:
        raise VolumeError(f"{path}: is {last - first}-dimensional; a volume has three dimensions")
    return StoredImage(
        voxels,
        voxels.size[0] if first else 1,
        lambda: _placement(path, fields, axes, given),
        texts=pairs,
    )


def _entries(path: Path, fields: Mapping[str, str], key: str, dimension: int) -> list[str] | None:
    """The entries of a field that has one for each axis."""
    if key not in fields:
        return None
    found = re.findall(r"\([^()]*\)|\"[^\"]*\"|[^\s()]+", fields[key])
    if len(found) != dimension:
        raise VolumeError(
            f"{path}: its {key} has {len(found)} entries where the image has {dimension} axes; "
            f"export it again"
        )
    return [word.strip('"') for word in found]


def _axes_of_space(path: Path, fields: Mapping[str, str], dimension: int) -> list[int]:
    """The axes with a direction, or of a kind along which the body extends; else the first 3."""
    if directions := _entries(path, fields, "space directions", dimension):
        return [n for n, each in enumerate(directions) if each != "none"]
    kinds = _entries(path, fields, "kinds", dimension) or []
    of_space = [n for n, kind in enumerate(kinds) if kind.lower() in ("domain", "space")]
    return of_space or list(range(min(dimension, 3)))


def _placement(
    path: Path, fields: Mapping[str, str], axes: list[int], given: ArrayLike | None
) -> NDArray[np.float64]:
    """(4, 4) m of the axes of space."""
    dimension = len(fields["sizes"].split())
    directions = _entries(path, fields, "space directions", dimension)
    if directions is None:
        units = _entries(path, fields, "units", dimension)
        scale = [_millimetres(path, units[n]) if units else 1.0 for n in axes]
        spacings = _entries(path, fields, "spacings", dimension)
        starts = _entries(path, fields, "axis mins", dimension) or ["0"] * dimension
        spacing = None
        if spacings:
            spacing = np.array([_number(path, "spacings", spacings[n]) for n in axes]) * scale
            spacing = None if np.isnan(spacing).all() else spacing
        origin = np.nan_to_num([_number(path, "axis mins", starts[n]) for n in axes])
        return checked_placement(path, spacing, np.eye(3), origin * scale, given)
    signs = _TO_LPS.get(fields.get("space", "").lower(), (1, 1, 1))
    units = _entries(path, fields, "space units", 3) or ["", "", ""]
    to_lps = np.array(signs, np.float64) * [_millimetres(path, unit) for unit in units]
    steps = np.column_stack([_vector(path, "space directions", directions[n]) for n in axes])
    origin = _vector(path, "space origin", fields.get("space origin", "(0,0,0)"))
    steps = steps * to_lps[:, None]
    spacing = np.linalg.norm(steps, axis=0)
    return checked_placement(
        path, spacing, steps / np.where(spacing > 0.0, spacing, 1.0), origin * to_lps, given
    )


def _millimetres(path: Path, unit: str) -> float:
    return millimetres(path, "" if unit.lower() in ("???", "none", "") else unit)


def _number(path: Path, key: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise VolumeError(
            f"{path}: its {key} has {text[:80]!r} where a number belongs; export it again"
        ) from None


def _vector(path: Path, key: str, text: str) -> NDArray[np.float64]:
    """(3,) of ``(x,y,z)``."""
    words = text.strip().removeprefix("(").removesuffix(")").split(",")
    vector = np.array([_number(path, key, word) for word in words])
    if len(vector) != 3 or not np.isfinite(vector).all():
        raise VolumeError(
            f"{path}: its {key} is not made of vectors of three finite numbers; export it again"
        )
    return vector
