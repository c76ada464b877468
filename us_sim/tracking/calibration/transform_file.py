"""A rigid transform in a YAML file, with the quality of its calibration.

`us-sim calibrate` writes it and a scene takes it as `registration:` or `calibration:`. The
pose is that of the frame `from` in the frame `to`, so it turns points of `from` into points of
`to`: a registration is from the device's frame to `patient`, a calibration from `probe` to the
tracked body.

>>> import pathlib, tempfile
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tracking.calibration.transform_file import read_transform, write_transform
>>> with tempfile.TemporaryDirectory() as folder:
...     file = pathlib.Path(folder, "registration.yaml")
...     write_transform(file, Pose([0.0, 0.0, 0.4]), from_frame="tracker", to_frame="patient",
...                     method="point registration", residuals={"fre": 0.0003})
...     read_transform(file).position
array([0. , 0. , 0.4])
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from us_sim.errors import CalibrationError
from us_sim.geometry.pose import Placement, Pose
from us_sim.settings.reading import SettingsReader
from us_sim.settings.text_files import read_yaml


def read_transform(path: str | Path) -> Pose:
    """Read the pose of the file's frame `from` in its frame `to`, m.

    Raises:
        CalibrationError: the file is missing, is no YAML, lacks the position or orientation, or
            these are not 3 and 4 finite numbers.
    """
    document = read_yaml(Path(path), CalibrationError)
    keys = ("position", "orientation")
    if not isinstance(document, dict) or not document.keys() >= set(keys):
        raise CalibrationError(
            f"{path}: holds no transform; it needs the keys {' and '.join(keys)}"
        )
    written = {key: document[key] for key in keys}
    return SettingsReader(str(path), error=CalibrationError).read(Placement, written).pose


def write_transform(
    path: str | Path,
    pose: Pose,
    *,
    from_frame: str,
    to_frame: str,
    method: str,
    residuals: Mapping[str, Any] | None = None,
    more: Mapping[str, Any] | None = None,
) -> None:
    """Write a transform that a scene takes.

    Args:
        path: of the new file.
        pose: of from_frame in to_frame, m.
        from_frame: the frame whose points it takes.
        to_frame: the frame in which it gives them.
        method: of the calibration, in a few words.
        residuals: numbers, arrays and mappings of them by name, SI units.
        more: further keys, of the same kinds.

    Raises:
        CalibrationError: the file exists already or cannot be written.
    """
    place = {"position": pose.position, "orientation": pose.orientation}  # m; x, y, z, w
    content = {"from": from_frame, "to": to_frame, **place, "method": method}
    write_calibration(path, {**content, "residuals": residuals or {}, **(more or {})})


def write_calibration(path: str | Path, content: Mapping[str, Any]) -> None:
    """Write the result of a calibration as YAML, with the date.

    Raises:
        CalibrationError: the file exists already or cannot be written.
    """
    path = Path(path)
    date = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    document = {"date": date} | {key: _plain(value) for key, value in content.items()}
    text = yaml.safe_dump(
        document, sort_keys=False, default_flow_style=None, width=100, allow_unicode=True
    )
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise CalibrationError(f"{path}: exists already; choose another name") from None
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be written: {error.strerror}") from error


def _plain(value: Any) -> Any:
    """Convert arrays and NumPy's numbers to types that YAML's safe subset can hold."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value
