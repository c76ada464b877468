"""Named points in files: CSV with a header, and the phantom definitions of Plus (XML).

>>> import pathlib, tempfile
>>> from us_sim.tracking.calibration.landmark_file import read_landmarks
>>> with tempfile.TemporaryDirectory() as folder:
...     file = pathlib.Path(folder, "phantom.csv")
...     _ = file.write_text("name,x,y,z\\nsternum,0.1,0,20 mm\\n")
...     read_landmarks(file)
{'sternum': array([0.1 , 0.  , 0.02])}
"""

from __future__ import annotations

import csv
import io
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import CalibrationError
from us_sim.settings.quantity import Quantity
from us_sim.settings.text_file import read_bytes, read_text

_MILLIMETRES = 1e-3  # Plus' unit


def read_landmarks(path: str | Path) -> dict[str, NDArray[np.float64]]:
    """Points (3,) m by name, in the file's order.

    Args:
        path: a CSV with the columns name, x, y, z (metres, or with a unit: 12 mm), or a Plus
            configuration with the Landmark elements of a phantom.

    Raises:
        CalibrationError: the file cannot be read, names a landmark twice or has none.
    """
    points = _read(Path(path), "landmark", ("Position",), ("x", "y", "z"))
    return {name: numbers[0] for name, numbers in points.items()}


def read_wires(path: str | Path) -> dict[str, NDArray[np.float64]]:
    """Wires (2, 3) m, both ends, by name.

    Args:
        path: a CSV with the columns name, x1, y1, z1, x2, y2, z2, or a Plus configuration with the
            Wire elements of a phantom.

    Raises:
        CalibrationError: the file cannot be read, names a wire twice or has none.
    """
    columns = ("x1", "y1", "z1", "x2", "y2", "z2")
    return _read(Path(path), "wire", ("EndPointFront", "EndPointBack"), columns)


def read_table(
    path: str | Path, columns: Mapping[str, str], *, label: str
) -> list[tuple[str, list[float]]]:
    """Rows of a CSV whose header names at least these columns: the label's text, and numbers.

    Args:
        path: of the file.
        columns: their names, and what they hold (length, number, time).
        label: name of the column with a text.

    Raises:
        CalibrationError: it cannot be read, or lacks a column, or a cell is no such quantity.
    """
    path = Path(path)
    quantities = {name: Quantity(dimension) for name, dimension in columns.items()}
    try:
        reader = csv.DictReader(io.StringIO(read_text(path, "utf-8-sig")), skipinitialspace=True)
        header = [name.strip() for name in reader.fieldnames or ()]
        reader.fieldnames = header
        missing = [name for name in (label, *columns) if name not in header]
        if missing:
            raise CalibrationError(
                f"{path}: has no column {missing[0]}; its first line must be "
                f"{','.join([label, *columns])}"
            )
        rows = []
        for row in reader:
            values = []
            for name, quantity in quantities.items():
                try:
                    values.append(quantity.parse(row[name] or ""))
                except ValueError as error:
                    raise CalibrationError(
                        f"{path}: line {reader.line_num}: {name}: {error}"
                    ) from error
            rows.append(((row[label] or "").strip(), values))
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be read: {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise CalibrationError(f"{path}: is no CSV: {error}") from error
    return rows


def _read(
    path: Path, what: str, attributes: Sequence[str], columns: Sequence[str]
) -> dict[str, NDArray[np.float64]]:
    """(K, 3) m by name, from a Plus configuration's attributes or a CSV's columns."""
    found: list[tuple[str, Any]]
    if path.suffix.lower() == ".xml":
        found = [
            (element.get("Name", ""), [_vector(path, element, key) for key in attributes])
            for element in _document(path).iter(what.capitalize())
        ]
    else:
        found = read_table(path, dict.fromkeys(columns, "length"), label="name")
    named: dict[str, NDArray[np.float64]] = {}
    for name, value in found:
        if not name:
            raise CalibrationError(f"{path}: a {what} has no name; name all of them")
        if name in named:
            raise CalibrationError(f"{path}: {what} {name} is there twice; name each only once")
        named[name] = np.array(value).reshape(-1, 3)
    if not named:
        raise CalibrationError(f"{path}: holds no {what}")
    return named


def _document(path: Path) -> ElementTree.Element:
    try:
        text = read_bytes(path)
        # Entities that expand without end are a known attack; no phantom needs any.
        if b"<!ENTITY" in text:
            raise CalibrationError(f"{path}: defines entities, which is not allowed; remove them")
        return ElementTree.fromstring(text)
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be read: {error.strerror}") from error
    except ElementTree.ParseError as error:
        raise CalibrationError(f"{path}: is not XML: {error}") from error


def _vector(path: Path, element: ElementTree.Element, key: str) -> NDArray[np.float64]:
    """(3,) m of an attribute in millimetres."""
    text = element.get(key, "")
    try:
        vector = np.array([float(number) for number in text.split()])
    except ValueError:
        vector = np.empty(0)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise CalibrationError(
            f"{path}: {element.tag} {element.get('Name', '')}: {key} must be 3 numbers in "
            f"millimetres, not {text!r}"
        )
    return vector * _MILLIMETRES
