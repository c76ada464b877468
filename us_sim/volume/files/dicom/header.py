"""DICOM headers: everything of a file but its images, and where in the file those are.

Nothing large is read: of the images and of private data only the place is kept. A deflated file is
inflated step by step, and no further than its own header says that it goes.
"""

from __future__ import annotations

import io
import math
import os
import struct
import warnings
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, cast

from us_sim.errors import VolumeError
from us_sim.volume.files.stored_image import check_claim

EXTRA = "pip install 'us_sim[dicom]'"

_DEFER = 1 << 20  # bytes of a value that is not read; a palette has 128 KiB a colour
_DEFLATED = "1.2.840.10008.1.2.1.99"
_NATIVE = ("1.2.840.10008.1.2", "1.2.840.10008.1.2.1", "1.2.840.10008.1.2.2", _DEFLATED, "")
_MOST_HEADER = 1 << 26  # bytes of an inflated file beside its images


@contextmanager
def quiet() -> Iterator[None]:
    """No warnings of pydicom: they would show the values that do not keep to the standard."""
    from pydicom import config

    before = config.settings.reading_validation_mode
    config.settings.reading_validation_mode = config.IGNORE
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        config.settings.reading_validation_mode = before


def value(header: Any, key: str | int) -> Any:
    """The value of an element by its keyword or tag; None where there is none that can be read.

    pydicom makes a value when it is first asked for, and raises whatever its bytes lead to.
    """
    try:
        if header is None or key not in header:
            return None
        with quiet():
            return header[key].value
    except Exception:  # the bytes of a stranger: struct, unicode, index and many other errors
        return None


def text(header: Any, key: str | int) -> str:
    """A text without blanks around it; of several the first; empty where there is none."""
    found = value(header, key)
    if isinstance(found, Sequence) and not isinstance(found, str | bytes):
        found = found[0] if len(found) else ""
    if isinstance(found, bytes):
        found = found.decode("latin-1")
    return "" if found is None else str(found).strip(" \0")


def numbers(header: Any, key: str | int, count: int | None = None) -> tuple[float, ...] | None:
    """Finite numbers, ``count`` of them where it is given; None where there are none such."""
    found = value(header, key)
    if found is None or isinstance(found, bytes):
        return None
    if isinstance(found, str):
        found = found.split("\\")
    try:
        made = tuple(float(each) for each in (found if isinstance(found, Sequence) else [found]))
    except (TypeError, ValueError, OverflowError):
        return None
    fits = made and len(made) == (count or len(made)) and all(map(math.isfinite, made))
    return made if fits else None


def number(header: Any, key: str | int) -> float | None:
    """A finite number; of several the first."""
    found = numbers(header, key)
    return found[0] if found else None


def whole(header: Any, key: str | int) -> int | None:
    """A whole number."""
    found = number(header, key)
    return int(found) if found is not None and found == int(found) else None


def items(header: Any, key: str | int) -> list[Any]:
    """The items of a sequence; none where there is none."""
    found = value(header, key)
    try:
        with quiet():
            return [] if found is None or isinstance(found, str | bytes) else list(found)
    except Exception:  # an item is made when it is asked for, too
        return []


def private(header: Any, group: int, creator: str, element: int) -> int | None:
    """The tag of a private element, of which the creator's name says where it is (PS3.5, 7.8.1)."""
    for block in range(0x10, 0x100):
        if text(header, (group << 16) | block).casefold() == creator.casefold():
            return (group << 16) | (block << 8) | element
    return None


@dataclass(frozen=True)
class PixelPlace:
    """Where the images are."""

    start: int  # byte of the file, or of the inflated bytes
    length: int | None  # bytes; None where they are in fragments, up to a delimiter
    element: int  # the tag: whole numbers, or numbers in single or double precision


@dataclass(frozen=True, eq=False)
class DicomFile:
    """A DICOM file that was opened."""

    path: Path
    header: Any  # pydicom.Dataset, whose values are read by the functions above
    syntax: str  # UID of the transfer syntax; empty where the file does not say
    little_endian: bool
    pixels: PixelPlace | None
    inflated: bytes | None = None

    @property
    def compressed(self) -> bool:
        """Whether the images are, each on its own."""
        return self.syntax not in _NATIVE

    @property
    def size(self) -> int:
        """Bytes there are."""
        return self.path.stat().st_size if self.inflated is None else len(self.inflated)

    def open(self) -> BinaryIO:
        """The bytes in which the place of the images counts."""
        return self.path.open("rb") if self.inflated is None else io.BytesIO(self.inflated)


def is_dicom(path: Path) -> bool:
    """Whether a file says that it is DICOM, by its first bytes or its name."""
    try:
        with path.open("rb") as file:
            start = file.read(132)
    except OSError:
        return False
    named = path.suffix.lower() in (".dcm", ".dicom", ".ima")
    return start[128:] == b"DICM" or _has_no_preamble(start) or named


def _has_no_preamble(start: bytes) -> bool:
    """Whether a file begins with an element of the groups that come first, as older ones do."""
    if len(start) < 8 or start[:2] not in (b"\x02\0", b"\x08\0") or start[3]:
        return False
    return (start[4:6].isalpha() and start[4:6].isupper()) or start[5:8] == b"\0\0\0"


def packed_in(path: Path) -> str:
    """The archive or compression that a file is, as a word for a person; empty of others."""
    with path.open("rb") as file:
        start = file.read(4)
    return {b"\x1f\x8b": "gzip", b"PK": "zip", b"BZ": "bzip2"}.get(start[:2], "")


def dicom_files(folder: Path) -> list[Path]:
    """The DICOM files in a folder.

    Raises:
        VolumeError: there are none.
    """
    found = [path for path in sorted(folder.iterdir()) if path.is_file() and is_dicom(path)]
    found = [path for path in found if path.name.upper() != "DICOMDIR"]
    if not found:
        raise VolumeError(f"{folder}: has no DICOM files in it; name a file")
    return found


def open_dicom(path: str | os.PathLike[str]) -> DicomFile:
    """Read the header of a DICOM file.

    Raises:
        VolumeError: there is no such file, it is none, its header breaks off, it inflates to more
            than it says, or pydicom is not installed.
    """
    path = Path(path)
    if not path.is_file():
        raise VolumeError(f"{path}: there is no such file")
    try:
        import pydicom  # noqa: F401
    except ImportError as error:
        raise VolumeError(f"{path}: reading DICOM needs an extra package: {EXTRA}") from error
    try:
        with quiet(), path.open("rb") as file:
            start = file.read(144)
            if start[128:132] != b"DICM" and not _has_no_preamble(start):
                raise VolumeError(f"{path}: is no DICOM file: it does not begin as one does")
            file.seek(0)
            try:
                return _read(path, file, path.stat().st_size)
            except _DeflatedError:
                inflated = _inflated(path, start)
                return _read(path, io.BytesIO(inflated), len(inflated), inflated)
    except (VolumeError, MemoryError):
        raise
    except Exception as error:  # pydicom raises what the bytes of a damaged file lead to
        if isinstance(error, OSError) and error.errno is not None:
            raise  # the file cannot be read at all
        raise VolumeError(
            f"{path}: cannot be read as DICOM: its header is damaged or cut short; copy or export "
            f"it again"
        ) from error


class _DeflatedError(Exception):
    """Everything behind the first elements is deflated."""


class _Bounded(io.BufferedIOBase):
    """A file that is never asked for more bytes than it has, as memory is taken for all of them.

    Only a deflated file is read to its end at once by pydicom, to be inflated without a limit.
    """

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file, self._size = file, size

    def read(self, count: int | None = -1, /) -> bytes:
        if count is None or count < 0:
            raise _DeflatedError
        return self._file.read(min(count, max(self._size - self._file.tell(), 0)))

    def seek(self, offset: int, whence: int = 0, /) -> int:
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()


def _read(path: Path, data: BinaryIO, size: int, inflated: bytes | None = None) -> DicomFile:
    from pydicom import dcmread
    from pydicom.filereader import read_dataset

    file = _Bounded(data, size)
    header = dcmread(file, defer_size=_DEFER, stop_before_pixels=True, force=True)
    syntax = _DEFLATED if inflated else text(header.file_meta, "TransferSyntaxUID")
    implicit, little = (each is not False for each in header.original_encoding)
    pixels = _pixel_place(file, implicit, "<" if little else ">")
    if pixels is not None:
        try:
            file.seek(pixels.start + pixels.length if pixels.length is not None else _end(file))
            more = read_dataset(cast(BinaryIO, file), implicit, little, defer_size=_DEFER)
            header.update(more)
        except Exception:  # what stands behind the images is not needed
            pass
    if not len(header):
        raise VolumeError(f"{path}: is no DICOM file: it has no elements")
    if pixels and pixels.length is not None and pixels.start + pixels.length > size:
        raise VolumeError(
            f"{path}: breaks off: it holds {max(size - pixels.start, 0)} of the {pixels.length} "
            f"bytes of its images; copy or export it again"
        )
    return DicomFile(path, header, syntax, little, pixels, inflated)


def _pixel_place(file: _Bounded, implicit: bool, order: str) -> PixelPlace | None:
    """Where the images are, in a file that stands at their element (PS3.5, 7.1.2)."""
    start = file.read(8)
    if len(start) < 8:
        return None
    group, element = struct.unpack(f"{order}2H", start[:4])
    if implicit:
        (length,) = struct.unpack(f"{order}I", start[4:])
    elif start[4:6] in b"OB OD OF OL OV OW SQ SV UC UN UR UT UV".split():
        more = file.read(4)
        if len(more) < 4:
            return None
        (length,) = struct.unpack(f"{order}I", more)
    else:
        (length,) = struct.unpack(f"{order}H", start[6:])
    tag = (group << 16) | element
    if tag not in (0x7FE00008, 0x7FE00009, 0x7FE00010):
        return None
    return PixelPlace(file.tell(), None if length == 0xFFFFFFFF else length, tag)


def _end(file: _Bounded) -> int:
    """The first byte behind the fragments of images, at the first of which a file stands."""
    while True:
        head = file.read(8)
        if len(head) < 8:
            return file.tell()
        tag, length = struct.unpack("<4sI", head)
        if tag != b"\xfe\xff\x00\xe0":
            return file.tell()
        file.seek(length, 1)


def _inflated(path: Path, start: bytes) -> bytes:
    """The file as if it had not been deflated (PS3.5, A.5), with a syntax that says so."""
    if len(start) < 144 or start[132:138] != b"\x02\0\0\0UL":
        raise VolumeError(f"{path}: is deflated, and does not say where that begins: export again")
    (meta,) = struct.unpack("<I", start[140:144])
    if 144 + meta > path.stat().st_size:
        raise VolumeError(f"{path}: breaks off in its header; copy or export it again")
    plain = b"\x02\0\x10\0UI\x14\0" + b"1.2.840.10008.1.2.1\0"  # explicit little endian
    made = bytearray(128) + b"DICM\x02\0\0\0UL\x04\0" + struct.pack("<I", len(plain)) + plain
    first = len(made)
    inflate, most, claimed = zlib.decompressobj(-zlib.MAX_WBITS), _MOST_HEADER, False
    with path.open("rb") as file:
        file.seek(144 + meta)
        try:
            while not inflate.eof:
                packed = inflate.unconsumed_tail or file.read(1 << 20)
                if not packed:
                    raise VolumeError(f"{path}: its compression is cut short; copy it again")
                made += inflate.decompress(packed, 1 << 20)
                if len(made) - first > most:
                    if claimed:
                        raise VolumeError(
                            f"{path}: inflates to more than the {most} bytes that its header says; "
                            f"export it again"
                        )
                    most, claimed = _MOST_HEADER + _claim(path, bytes(made)), True
        except zlib.error as error:
            raise VolumeError(f"{path}: its compression is damaged; copy it again") from error
    return bytes(made)


def _claim(path: Path, begun: bytes) -> int:
    """Bytes of images that the first part of a file says there are.

    Raises:
        VolumeError: they are more than is read.
    """
    from pydicom import dcmread

    file = _Bounded(io.BytesIO(begun), len(begun))
    header = dcmread(file, defer_size=_DEFER, stop_before_pixels=True, force=True)
    keys = ("NumberOfFrames", "Rows", "Columns", "SamplesPerPixel")
    size = tuple(max(whole(header, key) or 1, 1) for key in keys)
    sample = -(-max(whole(header, "BitsAllocated") or 8, 8) // 8)
    check_claim(path, size, sample)
    return sample * math.prod(size)
