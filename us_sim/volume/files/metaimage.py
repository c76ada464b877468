"""Headers of MetaImage files (itk.org/Wiki/MetaIO/Documentation).

SimpleITK does not read them here, as it would take wrong images and scales in silence: of packed
data that are damaged, or shorter or longer than said, it makes an image of what was in memory; a
spacing that is missing is 1 mm to it, a negative one is turned, and units are left out. Of a
sequence its time grows with the square of the frames.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.errors import VolumeError
from us_sim.volume.files.placement import checked_placement, millimetres
from us_sim.volume.files.stored_image import StoredImage, StoredVoxels

_TYPES = {
    "MET_CHAR": "i1", "MET_UCHAR": "u1", "MET_SHORT": "i2", "MET_USHORT": "u2",
    "MET_INT": "i4", "MET_UINT": "u4", "MET_LONG": "i4", "MET_ULONG": "u4",
    "MET_LONG_LONG": "i8", "MET_ULONG_LONG": "u8", "MET_FLOAT": "f4", "MET_DOUBLE": "f8",
}  # fmt: skip
"""MetaImage's element types (MetaIO, metaTypes.h)."""


def metaimage_header(path: Path) -> tuple[dict[str, str], int]:
    """Read the fields of a header, and the bytes it takes; ElementDataFile ends it."""
    fields: dict[str, str] = {}
    with path.open("rb") as file:
        for line in iter(lambda: file.readline(1 << 16), b""):
            key, equals, value = line.decode("latin-1").partition("=")
            fields[key.strip()] = value.strip()
            if key.strip() == "ElementDataFile":
                return fields, file.tell()
            if not equals:
                break
    raise VolumeError(
        f"{path}: cannot be read as an image: no ElementDataFile ends its header; give an MHA, "
        f"NRRD or NIfTI volume"
    )


def metaimage_voxels(path: Path, fields: Mapping[str, str], header_bytes: int) -> StoredVoxels:
    """Describe the numbers behind a header."""
    fields = {"ElementNumberOfChannels": "1", "NDims": "", "DimSize": "", **fields}
    channels = _sizes(path, fields, "ElementNumberOfChannels", 1)
    size = _sizes(path, fields, "DimSize", *_sizes(path, fields, "NDims", 1))
    element, name = fields.get("ElementType", ""), fields["ElementDataFile"]
    skip = fields.get("HeaderSize", "0")
    is_packed = _is_true(fields.get("CompressedData", ""))
    is_binary = _is_true(fields.get("BinaryData", "True"))
    is_list = name.upper().startswith("LIST") or "%" in name
    is_skip = skip.isdecimal() or (skip == "-1" and not is_packed)
    if element not in _TYPES or not is_binary or is_list or not is_skip:
        raise VolumeError(
            f"{path}: its ElementType is {element!r}, its ElementDataFile {name!r}, its HeaderSize "
            f"{skip!r}; save it as one .mha file of binary numbers"
        )
    data = path if name.upper() == "LOCAL" else path.parent / name
    order = fields.get("BinaryDataByteOrderMSB", fields.get("ElementByteOrderMSB", ""))
    return StoredVoxels(
        (*channels, *size) if channels != (1,) else size,
        np.dtype(f"{'>' if _is_true(order) else '<'}{_TYPES[element]}"),
        data,
        path,
        header_bytes if data == path else 0,
        int(skip),
        "packed" if is_packed else "raw",
    )


def metaimage_image(path: Path, given: ArrayLike | None = None) -> StoredImage:
    """Describe the image of a header.

    ``given`` is the spacing (3,) in mm of a file that does not state it.
    """
    fields, header_bytes = metaimage_header(path)
    voxels = metaimage_voxels(path, fields, header_bytes)
    count = len(fields["DimSize"].split())

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

    components = voxels.size[0] if len(voxels.size) > count else 1
    return StoredImage(voxels, components, placement)


def _numbers(
    path: Path, fields: Mapping[str, str], keys: tuple[str, ...], count: int
) -> NDArray[np.float64] | None:
    """Read the finite numbers of the first field that is there."""
    key = next((key for key in keys if key in fields), None)
    if key is None:
        return None
    with suppress(ValueError):
        numbers = np.array([float(word) for word in fields[key].split()])
        if len(numbers) == count and np.isfinite(numbers).all():
            return numbers
    raise _refused(path, key, fields[key], f"{count} finite numbers belong")


def _sizes(path: Path, fields: Mapping[str, str], key: str, count: int) -> tuple[int, ...]:
    """Read so many whole numbers above zero of a field."""
    words = fields[key].split()
    if len(words) != count or not all(word.isdecimal() and int(word) for word in words):
        raise _refused(path, key, fields[key], f"{count} whole numbers above zero belong")
    return tuple(map(int, words))


def _refused(path: Path, key: str, value: str, why: str) -> VolumeError:
    return VolumeError(
        f"{path}: cannot be read as an image: its {key} is {value[:80]!r} where {why}"
    )


def _is_true(text: str) -> bool:
    """As MetaIO reads it."""
    return text[:1] in ("T", "t", "1")
