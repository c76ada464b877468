"""Values of a DICOM header that nobody has checked.

pydicom makes a value when it is first asked for, and raises whatever the value's bytes lead to; a
value that cannot be made is one that is not there.

>>> from pydicom.dataset import Dataset
>>> from us_sim.volume.files.dicom.values import number, numbers, text, whole
>>> header = Dataset()
>>> header.Rows = 480; header.PixelSpacing = [0.5, 0.25]; header.Modality = "US"
>>> whole(header, "Rows"), numbers(header, "PixelSpacing", 2), text(header, "Modality")
(480, (0.5, 0.25), 'US')
>>> number(header, "SliceThickness") is None
True
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any


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
    """The value of an element by its keyword or tag; None where there is none that can be read."""
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
    """Finite numbers, ``count`` of them where it is given."""
    found = value(header, key)
    if found is None or isinstance(found, bytes):
        return None
    if isinstance(found, str):
        found = found.split("\\")
    listed = found if isinstance(found, Sequence) else [found]
    try:
        made = tuple(float(each) for each in listed)
    except (TypeError, ValueError, OverflowError):
        return None
    if not made or len(made) != (count or len(made)) or not all(map(math.isfinite, made)):
        return None
    return made


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
