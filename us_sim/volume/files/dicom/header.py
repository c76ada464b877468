"""DICOM files, read by pydicom."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Iterator, MutableSequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from us_sim.errors import VolumeError

EXTRA = "pip install 'us_sim[dicom]'"
EXPORT = (
    "export a maker's own 3D data as Enhanced US Volume, or save it as .nrrd in 3D Slicer with "
    "SlicerHeart"
)
"""Advice for GE's Kretz and movie groups, Philips' and Siemens' volumes."""


@contextmanager
def silence_pydicom() -> Iterator[None]:
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


def read_values(header: Any, key: str | int) -> list[Any]:
    """Return the values of an element; none where it is missing, empty or cannot be converted."""
    try:
        with silence_pydicom():
            found = header[key].value if key in header else None
    except Exception:  # pydicom converts a value when it is first asked for
        return []
    found = list(found) if isinstance(found, MutableSequence) else [found]
    return [each for each in found if each is not None]


def read_text(header: Any, key: str | int) -> str:
    """Return a text without blanks around it; of several the first; empty where there is none."""
    found = next(iter(read_values(header, key)), "")
    return str(found.decode("latin-1") if isinstance(found, bytes) else found).strip(" \0")


def read_numbers(header: Any, key: str | int, count: int | None = None) -> tuple[float, ...]:
    """Return finite numbers, ``count`` of them where it is given; else none."""
    try:
        found = tuple(float(each) for each in read_values(header, key))
    except (TypeError, ValueError):
        return ()
    return found if len(found) == (count or len(found)) and all(map(math.isfinite, found)) else ()


def read_number(header: Any, key: str | int) -> float | None:
    """Return a finite number; of several the first."""
    return next(iter(read_numbers(header, key)), None)


def read_items(header: Any, key: str | int) -> list[Any]:
    """Return the items of a sequence; none where there is none."""
    return [each for each in read_values(header, key) if not isinstance(each, str | bytes)]


def read_functional_groups(header: Any, frames: int) -> list[tuple[Any, ...]]:
    """Return the functional groups of each image (PS3.3, C.7.6.16): its own, then the shared."""
    shared = read_items(header, "SharedFunctionalGroupsSequence")[:1]
    own = read_items(header, "PerFrameFunctionalGroupsSequence")
    return [(group, *shared) for group in own] if len(own) == frames else [()] * frames


def is_dicom(path: Path) -> bool:
    """Tell whether a file begins as DICOM does, or as older files do, without a preamble."""
    with path.open("rb") as file:
        start = file.read(132)
    return start[128:] == b"DICM" or (start[:2] in (b"\x02\0", b"\x08\0") and not any(start[3:4]))


def no_image_error(path: Path, advice: str) -> VolumeError:
    """Return the error of a file that is no image; a packed one is called so."""
    with path.open("rb") as file:
        packed = {b"\x1f\x8b": "gzip", b"PK": "zip", b"BZ": "bzip2"}.get(file.read(2))
    return VolumeError(
        f"{path}: is packed as {packed}; unpack it first" if packed else f"{path}: {advice}"
    )


def find_dicom_files(folder: Path) -> list[Path]:
    """Return the DICOM files in a folder."""
    found = [path for path in sorted(folder.iterdir()) if path.is_file() and is_dicom(path)]
    found = [path for path in found if path.name.upper() != "DICOMDIR"]
    if not found:
        raise VolumeError(f"{folder}: has no DICOM files in it; name a file")
    return found


def open_dicom(path: str | os.PathLike[str]) -> Any:
    """Read a DICOM file: a `pydicom.FileDataset`, for the functions above."""
    path = Path(path)
    if not path.is_file():
        raise VolumeError(f"{path}: there is no such file")
    try:
        from pydicom import dcmread
        from pydicom.uid import ExplicitVRLittleEndian, ImplicitVRLittleEndian
    except ImportError as error:
        raise VolumeError(f"{path}: reading DICOM needs an extra package: {EXTRA}") from error
    if not is_dicom(path):
        raise VolumeError(f"{path}: is no DICOM file: it does not begin as one does")
    try:
        with silence_pydicom():
            header = dcmread(str(path), force=True)
    except Exception as error:  # of many kinds, which may show values
        raise VolumeError(
            f"{path}: cannot be read as DICOM: its header is damaged or cut; copy it again"
        ) from error
    if "TransferSyntaxUID" not in header.file_meta:  # older files do not say it
        implicit = header.original_encoding[0] is not False
        syntax = ImplicitVRLittleEndian if implicit else ExplicitVRLittleEndian
        header.file_meta.TransferSyntaxUID = syntax
    return header
