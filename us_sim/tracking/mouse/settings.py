"""What a scene says of a 6-DOF mouse: how its cap's deflection moves the probe.

>>> from us_sim.tracking.mouse.settings import SixDofMouseSettings
>>> settings = SixDofMouseSettings(mode="position", reach=["30 mm", "-30 mm", "-30 mm"])
>>> settings.reach, settings.axes
((0.03, -0.03, -0.03), (0, 1, 2, 3, 4, 5))
>>> SixDofMouseSettings(dead_band=2)
Traceback (most recent call last):
...
us_sim.errors.TrackingError: six_dof_mouse.dead_band: 2 is outside 0 to 0.9
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from us_sim.errors import TrackingError
from us_sim.settings.quantity import Quantity, given, require_given

__all__ = ["MOTION_FRAMES", "MOUSE_MODES", "SixDofMouseSettings"]

MOUSE_MODES = ("rate", "position")
MOTION_FRAMES = ("probe", "patient")

_PLACE = Quantity("length", -10.0, 10.0)
_BUTTON = Quantity("number", -1, 63)


@dataclass(frozen=True)
class SixDofMouseSettings:
    """The settings of the 6-DOF mouse; each is a key of a scene's ``tracker.six_dof_mouse:``.

    A full deflection is 1. The signs of the defaults turn the axes of REP 103, in which mice
    report (x forward, y left, z up), about x: so the probe goes down when the cap is pushed down.

    Raises:
        TrackingError: a value is out of range, or two do not go together.
    """

    mode: str = given(
        default="rate",
        choices=MOUSE_MODES,
        description="rate: the deflection is the probe's velocity; position: its displacement "
        "from where the clutch was let go",
    )
    frame: str = given(
        default="probe", choices=MOTION_FRAMES, description="whose axes the probe moves along"
    )
    axes: tuple[int, ...] = given(
        Quantity("number", 0, 63),
        default=(0, 1, 2, 3, 4, 5),
        description="which axes of the joystick move along x, y, z and turn about x, y, z",
    )
    speed: tuple[float, ...] = given(
        Quantity("speed", -1.0, 1.0),
        default=(0.05, -0.05, -0.05),
        description="m/s at full deflection along x, y, z, in rate mode",
    )
    angular_speed: tuple[float, ...] = given(
        Quantity("angular speed", -10.0, 10.0),
        default=(0.6, -0.6, -0.6),
        description="rad/s at full deflection about x, y, z, in rate mode",
    )
    reach: tuple[float, ...] = given(
        Quantity("length", -1.0, 1.0),
        default=(0.03, -0.03, -0.03),
        description="m at full deflection along x, y, z, in position mode",
    )
    angular_reach: tuple[float, ...] = given(
        Quantity("angle", -math.pi, math.pi),
        default=(0.5, -0.5, -0.5),
        description="rad at full deflection about x, y, z, in position mode",
    )
    dead_band: float = given(
        Quantity("number", 0.0, 0.9),
        default=0.05,
        description="deflection up to which an axis counts as at rest",
    )
    clutch_button: int = given(
        _BUTTON, default=0, description="button that holds the probe where it is; -1 for none"
    )
    reset_button: int = given(
        _BUTTON, default=1, description="button that brings the probe home; -1 for none"
    )
    home: tuple[float, ...] = given(
        _PLACE, default=(0.0, 0.0, -0.01), description="m, where the probe begins, in patient"
    )
    home_orientation: tuple[float, ...] = given(
        Quantity("number", -1.0, 1.0),
        default=(0.0, 0.0, 0.0, 1.0),
        description="quaternion x, y, z, w of the probe there",
    )
    workspace_low: tuple[float, ...] = given(
        _PLACE,
        default=(-0.2, -0.2, -0.1),
        description="m, least x, y, z of the probe in patient",
    )
    workspace_high: tuple[float, ...] = given(
        _PLACE,
        default=(0.2, 0.2, 0.1),
        description="m, largest x, y, z of the probe in patient",
    )
    longest_gap: float = given(
        Quantity("time", 1e-3, 10.0),
        default=0.1,
        description="s between two messages over which the velocity is still believed",
    )

    def __post_init__(self) -> None:
        require_given(self, "six_dof_mouse", TrackingError)
        object.__setattr__(self, "axes", self._whole_axes())
        for name, count in _COUNTS.items():
            if len(getattr(self, name)) != count:
                raise TrackingError(
                    f"six_dof_mouse.{name}: {getattr(self, name)} has {len(getattr(self, name))} "
                    f"numbers: give {count}"
                )
        if math.hypot(*self.home_orientation) < 1e-6:
            raise TrackingError(
                "six_dof_mouse.home_orientation: is zero, so it is no orientation: give "
                "[0, 0, 0, 1] for none"
            )
        if self.clutch_button == self.reset_button >= 0:
            raise TrackingError(
                f"six_dof_mouse.reset_button: {self.reset_button} is the clutch already: name "
                f"another button, or -1 for none"
            )
        bounds = zip(self.workspace_low, self.home, self.workspace_high, strict=True)
        if not all(low <= place <= high for low, place, high in bounds):
            raise TrackingError(
                f"six_dof_mouse.home: {self.home} is outside the workspace from "
                f"{self.workspace_low} to {self.workspace_high}: move it, or widen the workspace"
            )

    def _whole_axes(self) -> tuple[int, ...]:
        if any(axis != int(axis) for axis in self.axes) or len(set(self.axes)) != len(self.axes):
            raise TrackingError(
                f"six_dof_mouse.axes: {self.axes} must be six different whole numbers, from 0"
            )
        return tuple(int(axis) for axis in self.axes)


_COUNTS = {
    "axes": 6,
    "speed": 3,
    "angular_speed": 3,
    "reach": 3,
    "angular_reach": 3,
    "home": 3,
    "home_orientation": 4,
    "workspace_low": 3,
    "workspace_high": 3,
}
