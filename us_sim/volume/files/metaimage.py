"""MetaImage files (itk.org/Wiki/MetaIO/Documentation).

SimpleITK does not read them here: of packed data that are damaged, or shorter than said, it makes
an image of what was in memory; a spacing that is missing is 1 mm to it, units are left out, and of
a sequence its time grows with the square of the frames.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.errors import VolumeError
from us_sim.volume.files.placement import make_placement, to_millimetres
from us_sim.volume.files.stored_image import StoredImage, StoredNumbers

_TYPES = {
    "MET_CHAR": "i1", "MET_UCHAR": "u1", "MET_SHORT": "i2", "MET_USHORT": "u2",
    "MET_INT": "i4", "MET_UINT": "u4", "MET_LONG": "i4", "MET_ULONG": "u4",
    "MET_LONG_LONG": "i8", "MET_ULONG_LONG": "u8", "MET_FLOAT": "f4", "MET_DOUBLE": "f8",
}  # fmt: skip
"""MetaImage's element types (MetaIO, metaTypes.h)."""


def read_metaimage_header(path: Path) -> tuple[dict[str, str], int]:
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


def describe_metaimage_numbers(
    path: Path, fields: Mapping[str, str], header_bytes: int
) -> StoredNumbers:
    """Describe the numbers behind a header."""
    channels = int(_numbers(path, fields, 1, "ElementNumberOfChannels", default="1")[0])
    count = len(fields.get("DimSize", "").split())
    size = tuple(map(int, _numbers(path, fields, count, "DimSize")))
    element, name = fields.get("ElementType", ""), fields["ElementDataFile"]
    is_binary = _is_true(fields.get("BinaryData", "True"))
    is_list = name.upper().startswith("LIST") or "%" in name
    if element not in _TYPES or not is_binary or is_list or min((channels, *size), default=0) < 1:
        raise VolumeError(
            f"{path}: its ElementType is {element!r}, its DimSize {fields.get('DimSize', '')!r}, "
            f"its ElementDataFile {name!r}; save it as one .mha file of binary numbers"
        )
    data = path if name.upper() == "LOCAL" else path.parent / name
    order = fields.get("BinaryDataByteOrderMSB", fields.get("ElementByteOrderMSB", ""))
    is_packed = _is_true(fields.get("CompressedData", ""))
    return StoredNumbers(
        (channels, *size) if channels > 1 else size,
        np.dtype(f"{'>' if _is_true(order) else '<'}{_TYPES[element]}"),
        data,
        path,
        header_bytes if data == path else 0,
        int(_numbers(path, fields, 1, "HeaderSize", default="0")[0]),
        partial(zlib.decompress, wbits=32 + zlib.MAX_WBITS) if is_packed else None,
    )


def open_metaimage(path: Path) -> StoredImage:
    """Describe the image of a header."""
    fields, header_bytes = read_metaimage_header(path)
    numbers = describe_metaimage_numbers(path, fields, header_bytes)
    count = len(fields["DimSize"].split())

    def placement(given: ArrayLike | None = None) -> NDArray[np.float64]:
        """(4, 4) m of the first three axes; the matrix has one axis after another."""
        no_turn = " ".join(map(str, np.eye(count).ravel()))
        unit = to_millimetres(path, fields.get("DistanceUnits", "mm"))
        spacing, origin, axes = (
            _numbers(path, fields, length, *keys, default=default)
            for length, keys, default in (
                (count, ("ElementSpacing", "ElementSize"), "nan " * count),
                (count, ("Offset", "Position", "Origin"), "0 " * count),
                (count**2, ("TransformMatrix", "Rotation", "Orientation"), no_turn),
            )
        )
        stated = None if np.isnan(spacing).all() else unit * spacing[:3]
        direction = axes.reshape(count, count).T[:3, :3]
        return make_placement(path, stated, direction, unit * origin[:3], given)

    components = numbers.size[0] if len(numbers.size) > count else 1
    return StoredImage(path, numbers.size, numbers.type, components, placement, numbers.read)


def _numbers(
    path: Path, fields: Mapping[str, str], count: int, *keys: str, default: str = ""
) -> NDArray[np.float64]:
    """Read the numbers of the first field that is there."""
    key = next((key for key in keys if key in fields), keys[0])
    text = fields.get(key, default)
    try:
        return np.array([float(word) for word in text.split()]).reshape(count)
    except ValueError:
        raise VolumeError(
            f"{path}: cannot be read as an image: its {key} is {text[:80]!r} where {count or 3} "
            f"numbers belong"
        ) from None


def _is_true(text: str) -> bool:
    """Tell whether a text is true as MetaIO reads it."""
    return text[:1] in ("T", "t", "1")
