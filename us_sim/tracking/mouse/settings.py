"""The settings of a 6-DOF mouse in a scene: how its cap's deflection moves the probe.

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
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting

MOUSE_MODES = ("rate", "position")
MOTION_FRAMES = ("probe", "patient")

_PLACE = Quantity("length", -10.0, 10.0)
_BUTTON = Quantity("number", -1, 63)


@dataclass(frozen=True)
class SixDofMouseSettings(Settings):
    """The settings of the 6-DOF mouse; each is a key of a scene's ``tracker.six_dof_mouse:``.

    A full deflection is 1. The signs of the defaults turn the axes of REP 103, in which mice
    report (x forward, y left, z up), about x: so the probe goes down when the cap is pushed down.

    Raises:
        TrackingError: a value is out of range, or two do not go together.
    """

    section = "six_dof_mouse"
    error = TrackingError

    mode: str = setting(
        default="rate",
        choices=MOUSE_MODES,
        description="rate: the deflection is the probe's velocity; position: its displacement "
        "from where the clutch was let go",
    )
    frame: str = setting(
        default="probe", choices=MOTION_FRAMES, description="whose axes the probe moves along"
    )
    axes: tuple[int, int, int, int, int, int] = setting(
        Quantity("number", 0, 63),
        default=(0, 1, 2, 3, 4, 5),
        description="which axes of the joystick move along x, y, z and turn about x, y, z",
    )
    speed: tuple[float, float, float] = setting(
        Quantity("speed", -1.0, 1.0),
        default=(0.05, -0.05, -0.05),
        description="velocity at full deflection along x, y, z, in rate mode",
    )
    angular_speed: tuple[float, float, float] = setting(
        Quantity("angular speed", -10.0, 10.0),
        default=(0.6, -0.6, -0.6),
        description="angular velocity at full deflection about x, y, z, in rate mode",
    )
    reach: tuple[float, float, float] = setting(
        Quantity("length", -1.0, 1.0),
        default=(0.03, -0.03, -0.03),
        description="displacement at full deflection along x, y, z, in position mode",
    )
    angular_reach: tuple[float, float, float] = setting(
        Quantity("angle", -math.pi, math.pi),
        default=(0.5, -0.5, -0.5),
        description="turn at full deflection about x, y, z, in position mode",
    )
    dead_band: float = setting(
        Quantity("number", 0.0, 0.9),
        default=0.05,
        description="deflection up to which an axis counts as at rest",
    )
    clutch_button: int = setting(
        _BUTTON, default=0, description="button that holds the probe where it is; -1 for none"
    )
    reset_button: int = setting(
        _BUTTON, default=1, description="button that brings the probe home; -1 for none"
    )
    home: tuple[float, float, float] = setting(
        _PLACE, default=(0.0, 0.0, -0.01), description="where the probe begins, in patient"
    )
    home_orientation: tuple[float, float, float, float] = setting(
        Quantity("number", -1.0, 1.0),
        default=(0.0, 0.0, 0.0, 1.0),
        description="quaternion x, y, z, w of the probe there",
    )
    workspace_low: tuple[float, float, float] = setting(
        _PLACE,
        default=(-0.2, -0.2, -0.1),
        description="least x, y, z of the probe in patient",
    )
    workspace_high: tuple[float, float, float] = setting(
        _PLACE,
        default=(0.2, 0.2, 0.1),
        description="largest x, y, z of the probe in patient",
    )
    longest_gap: float = setting(
        Quantity("time", 1e-3, 10.0),
        default=0.1,
        description="time between two messages over which the velocity is still believed",
    )

    def check(self) -> None:
        """Six axes, an orientation, two buttons, and a home in the workspace."""
        if len(set(self.axes)) != len(self.axes):
            raise self.refused("axes", f"{self.axes} must be six different whole numbers, from 0")
        if math.hypot(*self.home_orientation) < 1e-6:
            raise self.refused(
                "home_orientation", "is zero, so it is no orientation: give [0, 0, 0, 1] for none"
            )
        if self.clutch_button == self.reset_button >= 0:
            raise self.refused(
                "reset_button",
                f"{self.reset_button} is the clutch already: name another button, or -1 for none",
            )
        bounds = zip(self.workspace_low, self.home, self.workspace_high, strict=True)
        if not all(low <= place <= high for low, place, high in bounds):
            raise self.refused(
                "home",
                f"{self.home} is outside the workspace from {self.workspace_low} to "
                f"{self.workspace_high}: move it, or widen the workspace",
            )
