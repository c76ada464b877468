"""Colour tables of DICOM as tables of grey values (PS3.3, C.7.6.3.1.5 and C.7.9.2).

>>> import pydicom.data
>>> from us_sim.volume.files.dicom.header import open_dicom
>>> from us_sim.volume.files.dicom.palette import grey_palette
>>> file = open_dicom(pydicom.data.get_testdata_file("examples_palette.dcm"))
>>> first, greys = grey_palette(file)
>>> first, greys.shape, greys.dtype
(0, (256,), dtype('uint8'))
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.files.dicom.header import DicomFile
from us_sim.volume.files.dicom.values import numbers, value

WEIGHTS = {"Red": 77, "Green": 150, "Blue": 29}
"""Of colours in a grey value, in 256ths (ITU-R BT.601, 2.5.1); a grey pixel stays as it is."""

_MOST = 1 << 16


def grey_palette(file: DicomFile) -> tuple[int, NDArray[np.uint8]]:
    """The stored value that the table begins with, and the grey value of each that follows.

    Raises:
        VolumeError: a table is missing or damaged.
    """
    order = "<" if file.little_endian else ">"
    total = np.zeros(1, np.float64)
    first = 0
    for colour, weight in WEIGHTS.items():
        described = numbers(file.header, f"{colour}PaletteColorLookupTableDescriptor", 3)
        if described is None:
            raise _refused(file, colour)
        count, first, bits = (int(each) for each in described)
        count = count % (_MOST + 1) or _MOST
        data = value(file.header, f"{colour}PaletteColorLookupTableData")
        if isinstance(data, bytes):
            table = _plain(data, count, order)
        else:
            data = value(file.header, f"Segmented{colour}PaletteColorLookupTableData")
            table = _expanded(data, count, order) if isinstance(data, bytes) else None
        if table is None or len(table) != count or bits not in (8, 16):
            raise _refused(file, colour)
        # Some writers give numbers of 8 bits in entries that say 16.
        top = 65535.0 if bits == 16 and table.max() > 255 else 255.0
        if len(total) not in (1, count):
            raise _refused(file, colour)
        total = total + weight / 256 * 255 * np.minimum(table / top, 1.0)
    return first, np.floor(total + 0.5).astype(np.uint8)


def _refused(file: DicomFile, colour: str) -> VolumeError:
    return VolumeError(
        f"{file.path}: its table of {colour.lower()} values is missing or damaged; export it in "
        f"grey values or RGB"
    )


def _plain(data: bytes, count: int, order: str) -> NDArray[np.int64] | None:
    """The entries, one after another in a byte or two."""
    if len(data) in (count, count + count % 2) and count > 1:
        return np.frombuffer(data[:count], np.uint8).astype(np.int64)
    if len(data) == 2 * count:
        return np.frombuffer(data, f"{order}u2").astype(np.int64)
    return None


def _expanded(data: bytes, count: int, order: str) -> NDArray[np.int64] | None:
    """The entries of a segmented table: runs of values, and straight lines between two."""
    words = np.frombuffer(data[: len(data) // 2 * 2], f"{order}u2").astype(np.int64)
    pieces: list[NDArray[Any]] = []
    made, at = 0, 0
    last: int | None = None
    while at + 1 < len(words) and made < count:
        kind, length = int(words[at]), int(words[at + 1])
        if kind == 0 and at + 2 + length <= len(words):
            piece, at = words[at + 2 : at + 2 + length], at + 2 + length
        elif kind == 1 and last is not None and at + 2 < len(words):
            steps = np.arange(1, length + 1) / max(length, 1)
            piece = np.floor(last + steps * (words[at + 2] - last) + 0.5).astype(np.int64)
            at += 3
        else:  # a segment that repeats others was never seen in an ultrasound image
            return None
        if len(piece):
            pieces.append(piece)
            made, last = made + len(piece), int(piece[-1])
    return np.concatenate(pieces) if pieces and made == count else None
