"""Headers of MetaImage files (itk.org/Wiki/MetaIO/Documentation), read without trust in them."""

from __future__ import annotations

import math
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

_LARGEST_HEADER = 1 << 26  # bytes; an hour of tracked frames takes less
_TYPES = {
    "MET_CHAR": "i1", "MET_UCHAR": "u1", "MET_SHORT": "i2", "MET_USHORT": "u2",
    "MET_INT": "i4", "MET_UINT": "u4", "MET_LONG": "i4", "MET_ULONG": "u4",
    "MET_LONG_LONG": "i8", "MET_ULONG_LONG": "u8", "MET_FLOAT": "f4", "MET_DOUBLE": "f8",
}  # fmt: skip
"""MetaImage's element types (MetaIO, metaTypes.h)."""


def metaimage_header(path: Path) -> tuple[dict[str, str], int]:
    """The fields of a MetaImage header, and the bytes it takes; ElementDataFile ends it.

    Raises:
        VolumeError: it does not end within 64 MiB.
    """
    fields: dict[str, str] = {}
    with path.open("rb") as file:
        while line := file.readline(1 << 16):
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
    """The voxels that a MetaImage header describes.

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
    element, name = fields["ElementType"], fields["ElementDataFile"]
    if element not in _TYPES:
        raise VolumeError(
            f"{path}: its ElementType is {element[:80]!r}; save it with one of {', '.join(_TYPES)}"
        )
    if name.upper().startswith("LIST") or "%" in name:
        raise VolumeError(f"{path}: keeps its voxels in several files; save it as one .mha file")
    is_local = name.upper() == "LOCAL"
    data = path if is_local else path.parent / name
    if not os.path.isfile(data):
        raise VolumeError(f"{path}: names the data file {name}, which is not there")
    start = header_bytes if is_local else 0
    packed = _is_true(fields.get("CompressedData", "False"))
    if packed and "CompressedDataSize" in fields:
        (stated,) = _whole_numbers(path, fields, "CompressedDataSize", 1)
        if stated != (there := data.stat().st_size - start):
            raise VolumeError(
                f"{path}: holds {there} bytes of image data where its header says {stated} "
                f"compressed ones; copy or export it again"
            )
    order = fields.get("BinaryDataByteOrderMSB", fields.get("ElementByteOrderMSB", "False"))
    encoding: Encoding = "packed" if packed else "raw"
    if not _is_true(fields.get("BinaryData", "True")):
        encoding = "text"
    stored = StoredVoxels(
        (channels, *size) if channels > 1 else size,
        np.dtype(f"{'>' if _is_true(order) else '<'}{_TYPES[element]}"),
        data,
        path,
        start,
        encoding=encoding,
    )
    before = fields.get("HeaderSize", "0")
    if before == "-1" and encoding == "raw":  # the last bytes of the file
        return replace(stored, start=max(data.stat().st_size - stored.expected, 0))
    if not re.fullmatch(r"[0-9]{1,9}", before):
        raise VolumeError(f"{path}: its HeaderSize is {before[:80]!r}; export it again")
    return replace(stored, start=start + int(before))


def metaimage_image(path: Path, given: ArrayLike | None = None) -> StoredImage:
    """The image that a header describes.

    ``given`` is the spacing, (3,) mm, of a file that does not state it.

    Raises:
        VolumeError: as `metaimage_header` and `metaimage_voxels`.
    """
    fields, header_bytes = metaimage_header(path)
    voxels = metaimage_voxels(path, fields, header_bytes)
    count = len(fields["DimSize"].split())
    components = voxels.size[0] if len(voxels.size) > count else 1

    def placement() -> NDArray[np.float64]:
        """(4, 4) m of the first three axes; the matrix has one axis after another."""
        unit = millimetres(path, fields.get("DistanceUnits", "mm"))
        spacing = _numbers(path, fields, ("ElementSpacing", "ElementSize"), count)
        origin = _numbers(path, fields, ("Offset", "Position", "Origin"), count)
        matrix = _numbers(path, fields, ("TransformMatrix", "Rotation", "Orientation"), count**2)
        axes = np.eye(count) if matrix is None else matrix.reshape(count, count).T
        return checked_placement(
            path,
            None if spacing is None else unit * spacing[:3],
            axes[:3, :3],
            np.zeros(3) if origin is None else unit * origin[:3],
            given,
        )

    return StoredImage(voxels, components, placement)


def _numbers(
    path: Path, fields: Mapping[str, str], keys: tuple[str, ...], count: int
) -> NDArray[np.float64] | None:
    """The finite numbers of the first field that is there."""
    key = next((key for key in keys if key in fields), None)
    if key is None:
        return None
    try:
        numbers = np.array([float(word) for word in fields[key].split()])
    except ValueError:
        numbers = np.array([math.nan])
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise VolumeError(
            f"{path}: its {key} is {fields[key][:80]!r} where {count} finite numbers belong; every "
            f"one must be a number: export it again"
        )
    return numbers


def _whole_numbers(
    path: Path, fields: Mapping[str, str], key: str, count: int | None = None
) -> tuple[int, ...]:
    """The whole numbers of a field; ``count`` of them where it is given."""
    words = fields[key].split()
    # int() would also take 1_000 and the digits of other scripts.
    are_whole = all(re.fullmatch(r"0*[1-9][0-9]{0,17}", word) for word in words)
    if not words or len(words) != (count or len(words)) or not are_whole:
        raise VolumeError(
            f"{path}: its {key} is {fields[key][:80]!r} where whole numbers above zero belong; "
            f"export it again"
        )
    return tuple(map(int, words))


def _is_true(text: str) -> bool:
    """As MetaIO reads it."""
    return text[:1] in ("T", "t", "1")
