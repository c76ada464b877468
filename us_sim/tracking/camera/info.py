"""Camera info: ROS's YAML file of a calibrated camera, read and written.

>>> import tempfile
>>> from pathlib import Path
>>> from us_sim.tracking.camera.info import read_camera_info, write_camera_info
>>> from us_sim.tracking.camera.model import CameraModel
>>> path = Path(tempfile.mkdtemp()) / "webcam.yaml"
>>> write_camera_info(path, CameraModel(640, 480, [[600, 0, 320], [0, 600, 240], [0, 0, 1]]))
>>> read_camera_info(path).matrix[0]
array([600.,   0., 320.])
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from us_sim.errors import TrackingError
from us_sim.settings.text_file import read_text
from us_sim.settings.yaml_text import YamlError, load_yaml
from us_sim.tracking.camera.model import CameraModel


def read_camera_info(path: Path | str) -> CameraModel:
    """The camera of a YAML file as ``camera_calibration`` and ``camera_info_manager`` write it.

    Raises:
        TrackingError: the file, or what it says, is not a camera's.
    """
    path = Path(path)
    try:
        content = load_yaml(read_text(path))
    except OSError as error:
        raise TrackingError(f"{path}: {error.strerror or error}") from error
    except (UnicodeDecodeError, YamlError) as error:
        raise TrackingError(f"{path}: not a YAML file of camera info: {_line(error)}") from error
    if not isinstance(content, Mapping):
        raise TrackingError(f"{path}: not camera info; it must be a mapping")
    wanted = ("image_width", "image_height", "camera_matrix", "distortion_coefficients")
    for key in wanted:
        if key not in content:
            raise TrackingError(f"{path}: {key} is missing; camera info has {', '.join(wanted)}")
    model = content.get("distortion_model", "plumb_bob")
    sizes = [content[key] for key in wanted[:2]]
    if not all(isinstance(size, int) and not isinstance(size, bool) for size in sizes):
        raise TrackingError(f"{path}: image_width and image_height must be whole, not {sizes}")
    try:
        return CameraModel(
            sizes[0],
            sizes[1],
            _data(content, "camera_matrix"),
            _data(content, "distortion_coefficients"),
            model,
        )
    except TrackingError as error:
        raise TrackingError(f"{path}: {error}") from error


def write_camera_info(
    path: Path | str,
    camera: CameraModel,
    name: str = "camera",
    notes: Mapping[str, Any] | None = None,
) -> None:
    """Write the file that `read_camera_info` and ROS's drivers read.

    Args:
        path: of the new file.
        camera: what it says.
        name: the camera's.
        notes: further keys, which readers pass over: how it was calibrated, and how well.

    Raises:
        TrackingError: the file exists.
    """
    path = Path(path)
    projection = np.hstack([camera.matrix, np.zeros((3, 1))])
    content: dict[str, Any] = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": name,
        "camera_matrix": _matrix(camera.matrix),
        "distortion_model": camera.distortion_model,
        "distortion_coefficients": _matrix(camera.distortion[None]),
        "rectification_matrix": _matrix(np.eye(3)),
        "projection_matrix": _matrix(projection),
        **(notes or {}),
    }
    try:
        with path.open("x", encoding="utf-8") as file:
            yaml.safe_dump(content, file, sort_keys=False, default_flow_style=None, width=100)
    except FileExistsError:
        raise TrackingError(f"{path}: exists already; choose another name") from None


def _data(content: Mapping[str, Any], key: str) -> Any:
    """The numbers of ``{rows, cols, data}``."""
    matrix = content[key]
    if not isinstance(matrix, Mapping) or "data" not in matrix:
        raise TrackingError(f"{key} must be a mapping with rows, cols and data")
    return matrix["data"]


def _matrix(values: np.ndarray[Any, Any]) -> dict[str, Any]:
    rows, columns = values.shape
    return {"rows": rows, "cols": columns, "data": [float(value) for value in values.ravel()]}


def _line(error: Exception) -> str:
    return str(error).splitlines()[0]
