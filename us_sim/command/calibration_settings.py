"""The options of `us-sim calibrate`, each a field of settings.

>>> from us_sim.command.calibration_settings import ClockCalibrationSettings
>>> ClockCalibrationSettings("tracker.mcap", "arm.mcap", largest="300 ms").largest
0.3
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from us_sim.errors import CalibrationError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting

_POSE = (
    "topic of a bag, or transform of Plus such as StylusToReference; may be left out where "
    "there is one only"
)


def _out(what: str, name: str) -> Path:
    """Make the setting of the file that a calibration writes."""
    file: Path = setting(description=f"file to write{what}", default=Path(name), kw_only=True)
    return file


@dataclass(frozen=True)
class CalibrationSettings(Settings):
    """Base of the settings of a calibration, each of which has a file ``out`` to write."""

    error = CalibrationError

    out: Path = _out("", "calibration.yaml")

    def check(self) -> None:
        """Refuse a file that exists or cannot be written, before the work."""
        self.require_new_file("out", ".yaml", ".yml")


@dataclass(frozen=True)
class CameraCalibrationSettings(CalibrationSettings):
    """Lens and focal length from photos of a board."""

    board: Path = setting(description="file of the board, as `us-sim print-marker` prints it")
    photos: tuple[str, ...] = setting(description="files, or folders of them")
    name: str = setting(description="the camera's name in the file", default="camera")
    out: Path = _out(": camera info", "camera.yaml")


@dataclass(frozen=True)
class PivotCalibrationSettings(CalibrationSettings):
    """A stylus' tip from turning it about the tip."""

    recording: Path = setting(description="bag, or tracker recording of Plus")
    pose: str | None = setting(description=_POSE, default=None)
    out: Path = _out(": the tip in the stylus' frame", "tip.yaml")


@dataclass(frozen=True)
class LandmarkCalibrationSettings(CalibrationSettings):
    """Pose of the tracker or the probe, from points touched."""

    known: Path = setting(description="landmarks in the patient's frame: CSV name,x,y,z")
    measured: Path = setting(
        description="the same as the tracker measured them: CSV, or a recording of the stylus that "
        "touched them in the file's order"
    )
    tip: Path | None = setting(description="the stylus' tip, of a recording", default=None)
    to: str = setting(description="frame of the known ones", default="patient")
    invert: bool = setting(
        description="the known frame in the measured one: a calibration, from points of the "
        "probe's face (--to probe) measured in its marker's frame",
        default=False,
    )
    pose: str | None = setting(description=_POSE, default=None)
    out: Path = _out(": the registration", "registration.yaml")


@dataclass(frozen=True)
class ClockCalibrationSettings(CalibrationSettings):
    """Offset of a tracker's clock from one motion."""

    moving: Path = setting(description="recording whose stamps are to be mended")
    fixed: Path = setting(description="recording whose stamps are right")
    largest: float = setting(Quantity("time", 0.01, 60.0), "largest offset to believe", default=0.5)
    pose: str | None = setting(description=_POSE, default=None)
    fixed_pose: str | None = setting(
        description="the same of the fixed recording, where it differs", default=None
    )
    out: Path = _out(": the offset", "time.yaml")
