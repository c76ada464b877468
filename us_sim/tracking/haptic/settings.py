"""The settings of a haptic arm in a scene: how it moves the probe, and the limits of its wrench.

>>> from us_sim.tracking.haptic.settings import HapticSettings
>>> HapticSettings(scale=2, ramp="500 ms").ramp
0.5
>>> HapticSettings(model_reach=3)
Traceback (most recent call last):
...
us_sim.errors.TrackingError: haptic.model_reach: 3 m is outside 0.0001 to 1 m; did you mean '3 cm'?
"""

from __future__ import annotations

from dataclasses import dataclass

from us_sim.errors import TrackingError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting


@dataclass(frozen=True)
class HapticSettings(Settings):
    """The settings of a haptic arm; each is a key of a scene's ``tracker.haptic:``.

    The defaults suit a small desktop arm that gives 3 N at most and no torque.

    Raises:
        TrackingError: a value is out of range, with its name and the range.
    """

    section = "haptic"
    error = TrackingError

    scale: float = setting(
        Quantity("number", 0.01, 100.0),
        default=1.0,
        description="how far the probe moves for a movement of the handle",
    )
    force_scale: float = setting(
        Quantity("number", 0.0, 100.0),
        default=1.0,
        description="how hard the handle is pushed for a force on the probe",
    )
    force_limit: float = setting(
        Quantity("force", 0.0, 50.0), default=3.0, description="largest force on the handle"
    )
    torque_limit: float = setting(
        Quantity("torque", 0.0, 5.0),
        default=0.0,
        description="largest torque on the handle; 0 for an arm that gives none",
    )
    rate: float = setting(
        Quantity("frequency", 50.0, 4000.0),
        default=1000.0,
        description="how often a wrench is sent",
    )
    ramp: float = setting(
        Quantity("time", 0.01, 30.0),
        default=1.0,
        description="time in which the force grows from nothing, at the start and after any doubt",
    )
    hand_over: float = setting(
        Quantity("time", 1e-3, 1.0),
        default=0.03,
        description="time for the change from one model of the contact to the next",
    )
    pose_timeout: float = setting(
        Quantity("time", 2e-3, 1.0),
        default=0.05,
        description="time without a pose after which the wrench is zero",
    )
    model_timeout: float = setting(
        Quantity("time", 5e-3, 5.0),
        default=0.3,
        description="age of the model of the contact from which on the wrench is zero",
    )
    jump: float = setting(
        Quantity("length", 1e-4, 1.0),
        default=0.01,
        description="movement of the handle between two poses, beyond which the wrench is zero",
    )
    rotation_jump: float = setting(
        Quantity("angle", 1e-3, 3.0),
        default=0.3,
        description="turn of the handle between two poses, beyond which the wrench is zero",
    )
    model_reach: float = setting(
        Quantity("length", 1e-4, 1.0),
        default=0.02,
        description="distance of the probe from where the contact is known, beyond which the "
        "wrench is zero",
    )
    model_rotation_reach: float = setting(
        Quantity("angle", 1e-3, 3.0),
        default=0.5,
        description="turn of the probe from where the contact is known, beyond which the wrench "
        "is zero",
    )
