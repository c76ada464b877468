"""Files that say where a body's markers are: YAML, text tables, and PLUS's marker maps.

>>> import tempfile
>>> from pathlib import Path
>>> from us_sim.tracking.camera.rigid_body_file import read_rigid_body
>>> path = Path(tempfile.mkdtemp()) / "grip.yaml"
>>> _ = path.write_text('''
... dictionary: 4X4_50
... markers:
...   - {id: 0, size: 30 mm}
...   - {id: 1, size: 30 mm, position: [0.02, 0, -0.02], orientation: [0, 0.7071, 0, 0.7071]}
... ''')
>>> read_rigid_body(path).normals.round(3) + 0.0
array([[0., 0., 1.],
       [1., 0., 0.]])
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from us_sim.errors import PoseError, TrackingError
from us_sim.geometry.pose import Pose
from us_sim.settings.quantity import Quantity
from us_sim.tracking.camera.markers import square
from us_sim.tracking.camera.rigid_body import RigidBody
from us_sim.tracking.camera.settings import MARKER_SIZE

__all__ = ["read_rigid_body"]

_LENGTH = Quantity("length", -10.0, 10.0)
_BOARDS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "grid": (("columns", "rows", "size", "separation"), ("first",)),
    "charuco": (("columns", "rows", "square", "size"), ("legacy",)),
}
_PLUS_DICTIONARIES = {
    "ARUCO": "ARUCO_ORIGINAL",
    "ARUCO_MIP_36H12": "ARUCO_MIP_36h12",
    "TAG16H5": "APRILTAG_16h5",
    "TAG25H9": "APRILTAG_25h9",
    "TAG36H10": "APRILTAG_36h10",
    "TAG36H11": "APRILTAG_36h11",
}


def read_rigid_body(path: Path | str, dictionary: str = "ARUCO_ORIGINAL") -> RigidBody:
    """The body that a file describes.

    Three kinds of file are read:

    - YAML: ``dictionary`` and either ``markers`` (each with ``id`` and either ``corners``,
      4 × 3 m, or ``size`` with the marker's ``position`` and ``orientation`` in the body), or
      ``board`` (``kind: grid`` with ``columns``, ``rows``, ``size``, ``separation`` and ``first``,
      or ``kind: charuco`` with ``columns``, ``rows``, ``square``, ``size`` and ``legacy``);
    - a marker map of the ArUco library, which PLUS's OpticalMarkerTracker takes as MarkerMapFile:
      YAML with ``aruco_bc_dict`` and ``aruco_bc_markers``, metres;
    - a text table (scikit-surgery's): a line for each marker with its number, its middle and its
      four corners, millimetres.

    Args:
        path: the file; its name's end says which kind it is (``.txt`` is a table).
        dictionary: of a file that names none.

    Raises:
        TrackingError: the file, or the body in it, cannot be used.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise TrackingError(f"{path}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise TrackingError(f"{path}: not a text file of markers") from error
    try:
        if path.suffix.lower() in (".txt", ".tsv", ".csv"):
            return _table(text, dictionary)
        content = _yaml(text)
        if "aruco_bc_markers" in content:
            return _marker_map(content, dictionary)
        return _body(content, dictionary)
    except TrackingError as error:
        raise TrackingError(f"{path}: {error}") from error


def _table(text: str, dictionary: str) -> RigidBody:
    ids, corners = [], []
    for number, line in enumerate(text.splitlines(), 1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        try:
            values = [float(word) for word in words]
        except ValueError:
            raise TrackingError(
                f"line {number}: {line.strip()!r} is not a row of numbers"
            ) from None
        if len(values) != 16 or values[0] != int(values[0]):
            raise TrackingError(
                f"line {number}: a marker has 16 numbers (its number, the middle and four corners "
                f"in mm), not {len(values)}"
            )
        ids.append(int(values[0]))
        corners.append(np.reshape(values[4:], (4, 3)) * 1e-3)
    if not ids:
        raise TrackingError("there is no marker in it")
    return RigidBody(dictionary, np.array(ids), np.array(corners))


def _yaml(text: str) -> Mapping[str, Any]:
    # OpenCV heads its files with "%YAML:1.0", which YAML itself does not know.
    lines = text.splitlines()
    if lines and lines[0].startswith("%YAML:"):
        lines[0] = ""
    try:
        content = yaml.safe_load("\n".join(lines))
    except yaml.YAMLError as error:
        raise TrackingError(f"not a YAML file: {str(error).splitlines()[0]}") from error
    if not isinstance(content, Mapping):
        raise TrackingError("it must be a mapping with dictionary and markers or board")
    return content


def _marker_map(content: Mapping[str, Any], dictionary: str) -> RigidBody:
    if content.get("aruco_bc_mInfoType") != 1:
        raise TrackingError(
            "its markers are in pixels (aruco_bc_mInfoType is not 1); convert the map to metres"
        )
    named = content.get("aruco_bc_dict")
    if named is not None:
        dictionary = _PLUS_DICTIONARIES.get(str(named).upper(), str(named))
    markers = _list(content, "aruco_bc_markers")
    ids = [_number(marker, f"aruco_bc_markers[{i}]") for i, marker in enumerate(markers)]
    corners = [_corners(marker, f"aruco_bc_markers[{i}]") for i, marker in enumerate(markers)]
    return RigidBody(dictionary, np.array(ids), np.array(corners))


def _body(content: Mapping[str, Any], dictionary: str) -> RigidBody:
    _require_keys(content, (), ("dictionary", "markers", "board"), "the file")
    dictionary = content.get("dictionary", dictionary)
    if ("markers" in content) == ("board" in content):
        raise TrackingError("it must have either markers or board")
    if "board" in content:
        return _board(content["board"], dictionary)
    ids, corners = [], []
    for i, marker in enumerate(_list(content, "markers")):
        where = f"markers[{i}]"
        ids.append(_number(marker, where))
        if "corners" in marker:
            _require_keys(marker, ("id", "corners"), (), where)
            corners.append(_corners(marker, where))
        else:
            _require_keys(marker, ("id", "size"), ("position", "orientation"), where)
            corners.append(_placed(marker, where))
    return RigidBody(dictionary, np.array(ids), np.array(corners))


def _board(board: Any, dictionary: str) -> RigidBody:
    kind = board.get("kind") if isinstance(board, Mapping) else None
    if kind not in _BOARDS:
        raise TrackingError(f"board.kind: {kind!r} is not one of {', '.join(_BOARDS)}")
    required, optional = _BOARDS[kind]
    _require_keys(board, ("kind", *required), optional, "board")
    values: dict[str, Any] = {key: board[key] for key in board if key != "kind"}
    for key, value in values.items():
        if key in ("columns", "rows", "first"):
            if not isinstance(value, int) or isinstance(value, bool):
                raise TrackingError(f"board.{key}: {value!r} is not a whole number")
        elif key == "legacy":
            if not isinstance(value, bool):
                raise TrackingError(f"board.legacy: {value!r} is not true or false")
        else:
            values[key] = _length(value, MARKER_SIZE, f"board.{key}")
    make: Any = RigidBody.grid if kind == "grid" else RigidBody.charuco
    return make(dictionary, **values)  # type: ignore[no-any-return]


def _placed(marker: Mapping[str, Any], where: str) -> NDArray[np.float64]:
    """Corners of a marker that is described by its size and pose."""
    size = _length(marker["size"], MARKER_SIZE, f"{where}.size")
    position = marker.get("position", [0.0, 0.0, 0.0])
    if not isinstance(position, list) or len(position) != 3:
        raise TrackingError(f"{where}.position: it must be 3 lengths, not {position!r}")
    place = [_length(value, _LENGTH, f"{where}.position") for value in position]
    try:
        orientation = np.array(marker.get("orientation", [0, 0, 0, 1]), dtype=np.float64)
        return Pose(np.array(place), orientation).apply(square(size))
    except (PoseError, TypeError, ValueError) as error:
        raise TrackingError(f"{where}.orientation: {error}") from error


def _list(content: Mapping[str, Any], key: str) -> list[Any]:
    items = content[key]
    if not isinstance(items, list) or not items:
        raise TrackingError(f"{key}: it must be a list of markers")
    return items


def _number(marker: Any, where: str) -> int:
    number = marker.get("id") if isinstance(marker, Mapping) else None
    if not isinstance(number, int) or isinstance(number, bool):
        raise TrackingError(f"{where}.id: {number!r} is not a marker's number")
    return number


def _corners(marker: Mapping[str, Any], where: str) -> NDArray[np.float64]:
    try:
        corners = np.array(marker.get("corners"), dtype=np.float64)
    except (TypeError, ValueError):
        corners = np.empty(0)
    if corners.shape != (4, 3):
        raise TrackingError(f"{where}.corners: they must be 4 × 3 numbers in metres")
    return corners


def _length(value: object, quantity: Quantity, where: str) -> float:
    try:
        return quantity.parse(value)
    except ValueError as error:
        raise TrackingError(f"{where}: {error}") from error


def _require_keys(
    content: Mapping[str, Any], required: tuple[str, ...], optional: tuple[str, ...], where: str
) -> None:
    for key in required:
        if key not in content:
            raise TrackingError(f"{where}: {key} is missing")
    unknown = [str(key) for key in content if key not in required + optional]
    if unknown:
        known = ", ".join(required + optional)
        raise TrackingError(f"{where}: {unknown[0]} is not known; there are {known}")
