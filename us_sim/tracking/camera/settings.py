"""The settings of the camera source in a scene: the body to look for, and when to believe it.

>>> import math
>>> from us_sim.tracking.camera.settings import CameraSettings
>>> settings = CameraSettings(dictionary="6X6_250", size="30 mm", marker=7)
>>> settings.size, round(math.degrees(settings.view_angle_limit))
(0.03, 75)
>>> CameraSettings(minimum_markers=0)
Traceback (most recent call last):
...
us_sim.errors.TrackingError: camera.minimum_markers: 0 is outside 1 to 1000
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from us_sim.errors import TrackingError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting

BOARDS_OF_MARKERS = ("charuco", "grid")
"""Kinds of flat boards that carry markers."""


DICTIONARIES = (
    *(f"{bits}X{bits}_{count}" for bits in (4, 5, 6, 7) for count in (50, 100, 250, 1000)),
    "ARUCO_ORIGINAL",
    "ARUCO_MIP_36h12",
    *(f"APRILTAG_{family}" for family in ("16h5", "25h9", "36h10", "36h11")),
)
"""The marker dictionaries, by OpenCV's names without ``DICT_``."""

MARKER_SIZE = Quantity("length", 1e-3, 0.25)


@dataclass(frozen=True)
class CameraSettings(Settings):
    """The settings of the camera source. Each is a key of a scene's ``tracker.camera:``.

    Raises:
        TrackingError: a value is out of range, with its name and the range.
    """

    section = "camera"
    error = TrackingError

    body: str = setting(
        default="",
        file=True,
        description="file of the rigid body of markers; empty for one marker",
    )
    marker: int = setting(
        Quantity("number", 0, 65535), default=0, description="number of the one marker"
    )
    size: float = setting(
        MARKER_SIZE, default=0.04, description="edge of the one marker's black square"
    )
    dictionary: str = setting(
        default="4X4_50",
        choices=DICTIONARIES,
        description="dictionary of the marker, or of a body's file that names none",
    )
    minimum_markers: int = setting(
        Quantity("number", 1, 1000),
        default=1,
        description="markers that must be seen for a pose to be taken",
    )
    reprojection_limit: float = setting(
        Quantity("image distance", 0.1, 50.0),
        default=2.0,
        description="root mean square between the corners seen and those of the pose",
    )
    view_angle_limit: float = setting(
        Quantity("angle", 0.1, 1.5),
        default=math.radians(75.0),
        description="angle between a marker's normal and the line of sight, beyond which it is "
        "not used",
    )
    corner_deviation: float = setting(
        Quantity("image distance", 0.01, 10.0),
        default=0.1,
        description="standard deviation of a corner, the least that the covariance of "
        "the pose is made with",
    )
    latency: float = setting(
        Quantity("time", -1.0, 1.0),
        default=0.0,
        description="time from the middle of the exposure to the image's stamp",
    )


def columns_and_rows(size: str) -> tuple[int, int]:
    """The numbers in a board's size, which a person writes as ``5x7``.

    Raises:
        TrackingError: it is written otherwise.
    """
    columns, _, rows = size.lower().partition("x")
    if not (columns.isdigit() and rows.isdigit()):
        raise TrackingError(f"--size {size}: write columns and rows, e.g. 5x7")
    return int(columns), int(rows)
