"""DICOM headers, read by pydicom; large values, such as the images, stay in the file."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from us_sim.errors import VolumeError

EXTRA = "pip install 'us_sim[dicom]'"

_DEFER = 1 << 20  # bytes of a value that stays in the file; a palette has 128 KiB a colour
_DEFLATED = "1.2.840.10008.1.2.1.99"
_PIXELS = (0x7FE00010, 0x7FE00008, 0x7FE00009)  # whole numbers, single and double precision


@contextmanager
def quiet() -> Iterator[None]:
    """Silence pydicom, whose warnings would show the values that do not keep to the standard."""
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

    pydicom converts a value when it is first asked for, and then raises many kinds of errors.
    """
    try:
        if header is None or key not in header:
            return None
        with quiet():
            return header[key].value
    except Exception:
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
    return [] if found is None or isinstance(found, str | bytes) else list(found)


def private(header: Any, group: int, creator: str, element: int) -> int | None:
    """The tag of a private element, of which the creator's name says where it is (PS3.5, 7.8.1)."""
    for block in range(0x10, 0x100):
        if text(header, (group << 16) | block).casefold() == creator.casefold():
            return (group << 16) | (block << 8) | element
    return None


@dataclass(frozen=True, eq=False)
class DicomFile:
    """A DICOM file that was opened."""

    path: Path
    header: Any  # pydicom.Dataset, whose values are read by the functions above
    syntax: str  # UID of the transfer syntax

    @property
    def pixels(self) -> Any:
        """The element of the images, without its value where this is large; None without one."""
        tags = [tag for tag in _PIXELS if tag in self.header]
        return self.header.get_item(tags[0], keep_deferred=True) if tags else None

    @property
    def deflated(self) -> bool:
        """Whether all of the file is, so that its images were read with the header."""
        return self.syntax == _DEFLATED


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
        VolumeError: there is no such file, it is none, it breaks off, or pydicom is not installed.
    """
    path = Path(path)
    if not path.is_file():
        raise VolumeError(f"{path}: there is no such file")
    try:
        from pydicom import dcmread
        from pydicom.uid import ExplicitVRLittleEndian, ImplicitVRLittleEndian
    except ImportError as error:
        raise VolumeError(f"{path}: reading DICOM needs an extra package: {EXTRA}") from error
    with path.open("rb") as file:
        start = file.read(132)
    if start[128:] != b"DICM" and not _has_no_preamble(start):
        raise VolumeError(f"{path}: is no DICOM file: it does not begin as one does")
    try:
        with quiet():
            header = dcmread(path, defer_size=_DEFER, force=True)
            syntax = text(header.file_meta, "TransferSyntaxUID")
            if syntax == _DEFLATED:
                header = dcmread(path, force=True)
    except OSError as error:
        if error.errno is not None:
            raise
        raise _damaged(path) from error
    except Exception as error:  # pydicom raises many kinds of errors
        raise _damaged(path) from error
    if not len(header):
        raise VolumeError(f"{path}: is no DICOM file: it has no elements")
    if not syntax:  # older files do not say it
        implicit = header.original_encoding[0] is not False
        syntax = str(ImplicitVRLittleEndian if implicit else ExplicitVRLittleEndian)
    made = DicomFile(path, header, syntax)
    length = getattr(made.pixels, "length", 0xFFFFFFFF)
    if length != 0xFFFFFFFF and syntax != _DEFLATED:
        there = path.stat().st_size - made.pixels.value_tell
        if there < length:
            raise VolumeError(
                f"{path}: breaks off: it holds {max(there, 0)} of the {length} bytes of its "
                f"images; copy or export it again"
            )
    return made


def _damaged(path: Path) -> VolumeError:
    return VolumeError(
        f"{path}: cannot be read as DICOM: its header is damaged or cut short; copy or export it "
        f"again"
    )
