"""Settings of the tracker sources and filters, each class a section of a scene's `tracker`.

A value that is out of range is a TrackingError with its name and the range, as are two that do not
go together.

>>> from us_sim.tracking.settings import GateSettings, OneEuroSettings
>>> GateSettings(jump="5 mm").jump
0.005
>>> OneEuroSettings(derivative_cutoff=0)
Traceback (most recent call last):
...
us_sim.errors.TrackingError: filter.derivative_cutoff: 0 Hz is outside 0.001 to 1000 Hz
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from us_sim.errors import TrackingError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting

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
    """The camera source: which markers are on the probe."""

    section = "camera"
    error = TrackingError

    body: str = setting(
        description="file of the rigid body of markers; empty for one marker", file=True, default=""
    )
    marker: int = setting(Quantity("number", 0, 65535), "number of the one marker", default=0)
    size: float = setting(MARKER_SIZE, "edge of the one marker's black square", default=0.04)
    dictionary: str = setting(
        description="of the one marker", choices=DICTIONARIES, default="4X4_50"
    )
    minimum_markers: int = setting(
        Quantity("number", 1, 1000), "fewest visible markers for a pose", default=1
    )


_CUTOFF = Quantity("frequency", 1e-3, 1e3)


@dataclass(frozen=True)
class OneEuroSettings(Settings):
    """The settings of the One-Euro filter.

    The defaults suit a hand-held probe: at rest the filter takes away most of what trembles above
    1.5 Hz, and in a sweep of 0.1 m/s it lags by 8 ms.
    """

    section = "filter"
    error = TrackingError
    live = True

    minimum_cutoff: float = setting(_CUTOFF, "cutoff of the position at rest", default=1.5)
    speed_coefficient: float = setting(
        Quantity("cutoff per speed", 0.0, 1e5),
        "how much the position's cutoff rises with speed",
        default=180.0,
    )
    rotation_minimum_cutoff: float = setting(_CUTOFF, "cutoff of the rotation at rest", default=1.5)
    rotation_speed_coefficient: float = setting(
        Quantity("cutoff per angular speed", 0.0, 1e5),
        "how much the rotation's cutoff rises with angular speed",
        default=20.0,
    )
    derivative_cutoff: float = setting(_CUTOFF, "cutoff of the speeds", default=1.0)


@dataclass(frozen=True)
class KalmanSettings(Settings):
    """The settings of the constant-velocity Kalman filter."""

    section = "filter"
    error = TrackingError
    live = True

    acceleration: float = setting(
        Quantity("acceleration noise", 1e-6, 1e4),
        "standard deviation of the speed's change within a second; it grows with the root of time",
        default=0.05,
    )
    angular_acceleration: float = setting(
        Quantity("angular acceleration noise", 1e-6, 1e5),
        "likewise of the angular speed",
        default=0.5,
    )
    position_deviation: float = setting(
        Quantity("length", 1e-9, 0.1),
        "standard deviation of each coordinate of a pose without covariance",
        default=3e-4,
    )
    rotation_deviation: float = setting(
        Quantity("angle", 1e-9, 1.0),
        "standard deviation about each axis of a pose without covariance",
        default=5e-3,
    )


@dataclass(frozen=True)
class GateSettings(Settings):
    """The gate, which refuses poses that are too far from the last one."""

    section = "gate"
    error = TrackingError

    maximum_speed: float = setting(
        Quantity("speed", 1e-3, 100.0), "largest speed of the probe's face", default=2.0
    )
    maximum_angular_speed: float = setting(
        Quantity("angular speed", 1e-2, 1e3), "largest angular speed of the probe", default=15.0
    )
    jump: float = setting(
        Quantity("length", 0.0, 1.0),
        "distance between two poses allowed in addition to the speed's: a pose's noise",
        default=5e-3,
    )
    rotation_jump: float = setting(
        Quantity("angle", 0.0, math.pi),
        "turn between two poses allowed in addition to the angular speed's",
        default=math.radians(5),
    )
    accept_after: int = setting(
        Quantity("number", 2, 10_000),
        "refused poses in a row that agree with each other, after which they are accepted",
        default=5,
    )


@dataclass(frozen=True)
class HapticSettings(Settings):
    """The settings of a haptic arm.

    The defaults suit a small desktop arm that gives 3 N at most and no torque.
    """

    section = "haptic"
    error = TrackingError

    scale: float = setting(
        Quantity("number", 0.01, 100.0),
        "how far the probe moves for a movement of the handle",
        default=1.0,
    )
    force_scale: float = setting(
        Quantity("number", 0.0, 100.0),
        "how hard the handle is pushed for a force on the probe",
        default=1.0,
    )
    force_limit: float = setting(
        Quantity("force", 0.0, 50.0), "largest force on the handle", default=3.0
    )
    torque_limit: float = setting(
        Quantity("torque", 0.0, 5.0),
        "largest torque on the handle; 0 for an arm that gives none",
        default=0.0,
    )
    rate: float = setting(
        Quantity("frequency", 50.0, 4000.0), "how often a wrench is sent", default=1000.0
    )
    ramp: float = setting(
        Quantity("time", 0.01, 30.0),
        "time in which the force grows from nothing, at the start and after any doubt",
        default=1.0,
    )
    hand_over: float = setting(
        Quantity("time", 1e-3, 1.0),
        "time for the change from one contact model to the next",
        default=0.03,
    )
    pose_timeout: float = setting(
        Quantity("time", 2e-3, 1.0),
        "time without a pose after which the wrench is zero",
        default=0.05,
    )
    model_timeout: float = setting(
        Quantity("time", 5e-3, 5.0),
        "age of the contact model after which the wrench is zero",
        default=0.3,
    )


_PLACE = Quantity("length", -10.0, 10.0)
_BUTTON = Quantity("number", -1, 63)


@dataclass(frozen=True)
class SixDofMouseSettings(Settings):
    """The settings of a 6-DOF mouse.

    The deflection is the probe's velocity; a full one is 1. The signs of the defaults turn the axes
    of REP 103, in which mice report (x forward, y left, z up), about x: so the probe goes down when
    the cap is pushed down.
    """

    section = "six_dof_mouse"
    error = TrackingError

    axes: tuple[int, int, int, int, int, int] = setting(
        Quantity("number", 0, 63),
        "which axes of the joystick move along x, y, z and turn about x, y, z",
        default=(0, 1, 2, 3, 4, 5),
    )
    speed: tuple[float, float, float] = setting(
        Quantity("speed", -1.0, 1.0),
        "velocity at full deflection along x, y, z",
        default=(0.05, -0.05, -0.05),
    )
    angular_speed: tuple[float, float, float] = setting(
        Quantity("angular speed", -10.0, 10.0),
        "angular velocity at full deflection about x, y, z",
        default=(0.6, -0.6, -0.6),
    )
    dead_band: float = setting(
        Quantity("number", 0.0, 0.9),
        "deflection up to which an axis counts as at rest",
        default=0.05,
    )
    clutch_button: int = setting(
        _BUTTON, "button that holds the probe where it is; -1 for none", default=0
    )
    reset_button: int = setting(
        _BUTTON, "button that brings the probe home; -1 for none", default=1
    )
    home: tuple[float, float, float] = setting(
        _PLACE, "where the probe begins, in patient", default=(0.0, 0.0, -0.01)
    )
    workspace_low: tuple[float, float, float] = setting(
        _PLACE, "least x, y, z of the probe in patient", default=(-0.2, -0.2, -0.1)
    )
    workspace_high: tuple[float, float, float] = setting(
        _PLACE, "largest x, y, z of the probe in patient", default=(0.2, 0.2, 0.1)
    )

    def check(self) -> None:
        """Refuse equal axes or buttons, and a home outside the workspace."""
        if len(set(self.axes)) != len(self.axes):
            raise self.make_error(
                "axes", f"{self.axes} must be six different whole numbers, from 0"
            )
        if self.clutch_button == self.reset_button >= 0:
            raise self.make_error(
                "reset_button",
                f"{self.reset_button} is the clutch already: name another button, or -1 for none",
            )
        bounds = zip(self.workspace_low, self.home, self.workspace_high, strict=True)
        if not all(low <= place <= high for low, place, high in bounds):
            raise self.make_error(
                "home",
                f"{self.home} is outside the workspace from {self.workspace_low} to "
                f"{self.workspace_high}: move it, or widen the workspace",
            )


@dataclass(frozen=True)
class OpenIGTLinkSettings(Settings):
    """The connection to an OpenIGTLink server.

    Which of the server's devices is the probe is the scene's ``tracker.body``.
    """

    section = "openigtlink"
    error = TrackingError

    host: str = setting(description="name or address of the server", default="localhost")
    port: int = setting(Quantity("number", 1, 65535), "TCP port", default=18944)
    world: str = setting(
        description="frame of the poses: the tracker's own, or an image's LPS or RAS; 3D Slicer "
        "sends RAS, which becomes the volumes' LPS",
        choices=("tracker", "lps", "ras"),
        default="tracker",
    )
    clock: str = setting(
        description="server: the messages' own stamps; arrival: when they come, for a server "
        "whose clock is not this computer's",
        choices=("server", "arrival"),
        default="server",
    )
    tracking_data: bool = setting(
        description="ask for TDATA, for servers that send nothing unasked", default=False
    )

    def check(self) -> None:
        """Refuse a server without a name."""
        if not self.host.strip():
            raise self.make_error("host", "is empty: name the server, or localhost")
