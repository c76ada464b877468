"""Tables of labels: numbers, names and colours, as 3D Slicer, ITK-SNAP and spreadsheets write them.

>>> import pathlib, tempfile
>>> from us_sim.volume.files.label_table import read_label_table
>>> with tempfile.TemporaryDirectory() as folder:
...     path = pathlib.Path(folder, "labels.ctbl")
...     _ = path.write_text("# Color table\\n0 background 0 0 0 0\\n6 portal_vein 0 0 255 255\\n")
...     read_label_table(path)[6]
('portal_vein', (0.0, 0.0, 1.0))
"""

from __future__ import annotations

import csv
import re
from pathlib import Path

from us_sim.errors import VolumeError
from us_sim.settings.spelling import shown
from us_sim.settings.text_files import read_text
from us_sim.volume.anatomical_colours import Colour

_SLICER = re.compile(r"(\d{1,9})\s+(\S+)\s+(\d{1,3})\s+(\d{1,3})\s+(\d{1,3})\s+(\d{1,3})")
_SNAP = re.compile(r"(\d{1,9})\s+(\d{1,3})\s+(\d{1,3})\s+(\d{1,3})(?:\s+[\d.]{1,9}){3}\s+\"(.*)\"")
_LONGEST = 1 << 20


def read_label_table(path: Path) -> dict[int, tuple[str, Colour | None]]:
    """Names and colours by label.

    Three forms are read: Slicer's colour tables (``.ctbl``: label, name, red, green, blue, alpha),
    ITK-SNAP's label descriptions (label, red, green, blue, three more numbers, the name in quotes),
    and comma-separated ones (label, name). Lines that begin with # are remarks, a first line of
    words a heading.

    Raises:
        VolumeError: the file cannot be read, or a line is none of these.
    """
    try:
        text = read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        raise VolumeError(f"{path}: cannot be read as a table of labels: {error}") from error
    if len(text) > _LONGEST:
        raise VolumeError(f"{path}: has {len(text)} characters, too many for a table of labels")
    table: dict[int, tuple[str, Colour | None]] = {}
    lines = [line.strip() for line in text.lstrip("\ufeff").splitlines()]
    for number, line in enumerate(lines, start=1):
        if not line or line.startswith("#") or (not table and not line[0].isdigit()):
            continue
        entry = _entry(line)
        if entry is None:
            raise VolumeError(
                f"{path}: line {number}: {shown(line[:80])} is no label: write `6 vein 0 0 255 "
                f"255`, or `6,vein`"
            )
        label, name, colour = entry
        if label in table:
            raise VolumeError(f"{path}: line {number}: label {label} is there twice: keep one")
        table[label] = (name, colour)
    if not table:
        raise VolumeError(f"{path}: holds no labels; write a line such as `6 vein 0 0 255 255`")
    return table


def _entry(line: str) -> tuple[int, str, Colour | None] | None:
    if match := _SLICER.fullmatch(line):
        label, name, *colour = match.groups()
        return int(label), name, _colour(colour[:3])
    if match := _SNAP.fullmatch(line):
        label, *colour, name = match.groups()
        return int(label), name.strip(), _colour(colour)
    cells = next(csv.reader([line], skipinitialspace=True), [])
    if len(cells) >= 2 and re.fullmatch(r"\d{1,9}", cells[0].strip()) and cells[1].strip():
        return int(cells[0]), cells[1].strip(), None
    return None


def _colour(texts: list[str]) -> Colour | None:
    red, green, blue = (int(text) / 255 for text in texts)
    return (red, green, blue) if max(red, green, blue) <= 1.0 else None
