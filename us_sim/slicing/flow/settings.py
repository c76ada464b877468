"""The settings of a vessel's flow: what a scene says of the blood in a structure.

>>> from us_sim.slicing.flow.settings import FlowSettings
>>> FlowSettings("arterial", (0, 1, 0), peak_velocity="80 cm/s", mean_velocity="9 cm/s").heart_rate
1.1
>>> FlowSettings("arterial", (0, 1, 0), peak_velocity=0.1, mean_velocity=0.09)
Traceback (most recent call last):
...
us_sim.errors.SceneError: flow.peak_velocity: 0.1 m/s is less than twice mean_velocity, 0.09 m/s: \
on the axis of a vessel blood flows twice as fast as in its mean
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from us_sim.errors import SceneError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting

_PRESSURE = Quantity("pressure", 10.0, 40e3)
_RATE = Quantity("rate", 0.02, 5.0)
_VENOUS = ("kind", ("venous",))

_ARTERIAL_PRESSURE, _VENOUS_PRESSURE = 12.4e3, 1.0e3
"""Pa, mean pressures in a vessel of the arm at the height of the heart: 93 and 8 mmHg
(Hall, Guyton and Hall Textbook of Medical Physiology, 13th ed., 2016, chapters 14 and 15)."""


@dataclass(frozen=True)
class FlowSettings(Settings):
    """The blood in a vessel: how fast, whereto, and what drives it.

    The defaults of the pressures are those of Hall, Guyton and Hall Textbook of Medical Physiology,
    13th ed., 2016, chapters 14 and 15.

    Raises:
        SceneError: a value is out of range, or two do not go together.
    """

    section = "flow"
    error = SceneError
    live = True

    kind: str = setting(
        description="arterial: a pulse, and pressure enough to go on until the vessel closes; "
        "venous: swings with breathing, fills up behind a closure and surges once that opens",
        choices=("arterial", "venous"),
    )
    direction: tuple[float, float, float] = setting(
        Quantity("number", -1.0, 1.0),
        "whereto blood flows, as x, y and z in `patient`; roughly, the vessel says the rest",
    )
    peak_velocity: float = setting(
        Quantity("speed", 0.01, 5.0),
        "on the vessel's axis at the height of the pulse: an artery's systolic peak",
    )
    mean_velocity: float = setting(
        Quantity("speed", 1e-3, 2.0), "over time and the cross-section, with the tissue at rest"
    )
    heart_rate: float = setting(_RATE, "beats: `66 /min`", default=1.1)
    respiration_rate: float = setting(_RATE, "breaths: `15 /min`", default=0.25, applies=_VENOUS)
    pressure: float | None = setting(
        _PRESSURE,
        "mean in the vessel at rest, over that where its blood goes; not given: 12.4 kPa arterial, "
        "1 kPa venous",
        default=None,
    )
    bed_pressure: float = setting(
        Quantity("pressure", 1e3, 40e3),
        "mean of the capillaries, to which a vein fills up behind a closure; over that in the vein "
        "it is how many times the flow at rest the surge begins with",
        default=3.3e3,
        applies=_VENOUS,
    )
    filling_time: float = setting(
        Quantity("time", 0.05, 120.0),
        "constant of the filling behind a closure",
        default=6.0,
        applies=_VENOUS,
    )
    closed_at: float = setting(
        Quantity("number", 0.0, 0.9),
        "fraction of its area at rest at which opposite walls touch and the vessel is closed",
        default=0.27,
    )

    def check(self) -> None:
        """Refuse velocities, pressures and a direction that cannot be."""
        if math.hypot(*self.direction) < 1e-3:
            raise self.refused("direction", "has no length: give where the blood flows")
        if self.peak_velocity < 2.0 * self.mean_velocity:
            raise self.refused(
                "peak_velocity",
                f"{self.peak_velocity:g} m/s is less than twice mean_velocity, "
                f"{self.mean_velocity:g} m/s: on the axis of a vessel blood flows twice as fast as "
                f"in its mean",
            )
        if self.kind == "venous" and self.bed_pressure <= self.pressure_at_rest:
            raise self.refused(
                "bed_pressure",
                f"{self.bed_pressure:g} Pa is not above the {self.pressure_at_rest:g} Pa in the "
                f"vein, so nothing would flow into it",
            )

    @property
    def pressure_at_rest(self) -> float:
        """Pa, mean in the vessel at rest, over that where its blood goes."""
        if self.pressure is not None:
            return self.pressure
        return _ARTERIAL_PRESSURE if self.kind == "arterial" else _VENOUS_PRESSURE
