"""Headers of NRRD files (teem.sourceforge.net/nrrd/format.html), parsed by pynrrd."""

from __future__ import annotations

import bz2
import gzip
import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import nrrd
import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.errors import VolumeError
from us_sim.volume.files.placement import make_placement, to_millimetres
from us_sim.volume.files.stored_image import StoredImage, StoredNumbers

_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
_TYPES |= {"longlong": "i8", "ulonglong": "u8", "float": "f4", "double": "f8"}
_UNPACK = {"raw": None, "gzip": gzip.decompress, "gz": gzip.decompress}
_UNPACK |= {"bzip2": bz2.decompress, "bz2": bz2.decompress}
_TO_LPS = {
    "left-posterior-superior": (1, 1, 1),
    "right-anterior-superior": (-1, -1, 1),
    "left-anterior-superior": (1, -1, 1),
}
_TO_LPS |= {"lps": (1, 1, 1), "ras": (-1, -1, 1), "las": (1, -1, 1)}
"""Signs that turn a space's axes to left-posterior-superior."""
_DIRECTIONS = "space directions"


def read_nrrd_header(path: Path) -> tuple[dict[str, Any], int]:
    """Parse a header: its fields and keys, as pynrrd has them, and the bytes up to its voxels."""
    try:
        with path.open("rb") as file:
            # UTF-8, which most programs write, and of which pynrrd itself keeps the ASCII alone.
            lines = (line.decode("utf-8", "replace") for line in iter(file.readline, b""))
            return nrrd.read_header(lines), file.tell()
    except (nrrd.NRRDError, ValueError, StopIteration) as error:
        raise VolumeError(
            f"{path}: cannot be read as an image: it is no NRRD file ({error}); give an MHA, NRRD, "
            f"NIfTI or DICOM volume"
        ) from error


def describe_nrrd_numbers(path: Path, fields: Mapping[str, Any], start: int) -> StoredNumbers:
    """Describe the numbers behind a header that ends at byte ``start``.

    They are not read by pynrrd, which takes the first of several members of gzip, as IGSIO writes.
    """
    size = tuple(int(length) for length in fields.get("sizes", ()))
    kind, encoding = fields.get("type", ""), fields.get("encoding", "").lower()
    name = kind.lower().removeprefix("signed ").replace("unsigned ", "u").removesuffix(" int")
    name = name.removesuffix("_t").replace(" ", "")
    name = _TYPES.get(name, name if re.fullmatch("u?int(8|16|32|64)", name) else "")
    data = fields.get("data file", fields.get("datafile", path.name))
    is_odd = {"line skip", "lineskip"} & fields.keys() or min(size, default=0) < 1
    if not name or encoding not in _UNPACK or is_odd or data.startswith("LIST") or "%" in data:
        raise VolumeError(
            f"{path}: cannot be read as an image: it holds {kind!r} in the encoding {encoding!r} "
            f"and sizes {' '.join(map(str, size))!r}, or in several files, or behind lines; save "
            f"it as one .nrrd of numbers: raw, gzip or bzip2"
        )
    number = np.dtype(name).newbyteorder(">" if fields.get("endian") == "big" else "<")
    file = path.parent / data
    start = start if file == path else 0
    skip = fields.get("byte skip", fields.get("byteskip", 0))
    return StoredNumbers(size, number, file, path, start, skip, _UNPACK[encoding])


def open_nrrd(path: Path) -> StoredImage:
    """Describe an image, whose first axis may be numbers of a voxel and whose last one volumes."""
    fields, start = read_nrrd_header(path)
    numbers = describe_nrrd_numbers(path, fields, start)
    count = len(numbers.size)
    for key in (_DIRECTIONS, "kinds", "spacings", "units", "axis mins"):
        if len(entries := fields.get(key, numbers.size)) != count:
            raise VolumeError(
                f"{path}: its {key} has {len(entries)} entries where the image has {count} axes"
            )
    axes = _axes_of_space(fields, count)
    if axes not in ([0, 1, 2], [1, 2, 3]) or count - axes[-1] > 2:
        raise VolumeError(
            f"{path}: is {len(axes)}-dimensional: of its {count} axes these are of space: "
            f"{', '.join(str(n + 1) for n in axes) or 'none'}; a volume has three in a row"
        )
    first = axes[0]
    remark = "the file names no anatomical space: left-posterior-superior is assumed"
    return StoredImage(
        path,
        numbers.size,
        numbers.type,
        numbers.size[0] if first else 1,
        partial(_placement, path, fields, axes),
        numbers.read,
        texts={key: value for key, value in fields.items() if isinstance(value, str)},
        remarks=() if "space" in fields else (remark,),
    )


def _axes_of_space(fields: Mapping[str, Any], count: int) -> list[int]:
    """Find the axes with a direction, or of a kind along which bodies extend; else the first 3."""
    if _DIRECTIONS in fields:
        return [n for n, each in enumerate(fields[_DIRECTIONS]) if not np.isnan(each).all()]
    kinds = fields.get("kinds", ())
    of_space = [n for n, kind in enumerate(kinds) if kind.lower() in ("domain", "space")]
    return of_space or list(range(min(count, 3)))


def _placement(
    path: Path, fields: Mapping[str, Any], axes: list[int], given: ArrayLike | None = None
) -> NDArray[np.float64]:
    """Place the axes of space: (4, 4) m."""
    space = fields.get("space", "lps").lower()
    if space not in _TO_LPS:
        raise VolumeError(
            f"{path}: its space is {space}, which does not say where the body's sides are; write "
            f"the right one into its header, such as left-posterior-superior"
        )
    if _DIRECTIONS not in fields:
        units = fields.get("units", [""] * (axes[-1] + 1))
        scale = np.array([to_millimetres(path, units[n]) for n in axes])
        stated = np.asarray(fields.get("spacings", np.full(axes[-1] + 1, np.nan)))[axes] * scale
        starts = np.asarray(fields.get("axis mins", np.zeros(axes[-1] + 1)))[axes]
        spacing = None if np.isnan(stated).all() else stated
        return make_placement(path, spacing, np.eye(3), np.nan_to_num(starts) * scale, given)
    to_lps = np.array(_TO_LPS[space], np.float64)
    to_lps *= [to_millimetres(path, unit) for unit in fields.get("space units", [""] * 3)]
    steps = np.asarray(fields[_DIRECTIONS])[axes].T
    origin = np.asarray(fields.get("space origin", np.zeros(3)))
    if steps.shape != (3, 3) or origin.shape != (3,):
        raise VolumeError(f"{path}: its axes are not placed in three dimensions; export it again")
    steps = steps * to_lps[:, None]
    spacing = np.linalg.norm(steps, axis=0)
    direction = steps / np.where(spacing > 0.0, spacing, 1.0)
    return make_placement(path, spacing, direction, origin * to_lps, given)
