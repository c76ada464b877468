"""The settings of pulsed-wave Doppler."""

from __future__ import annotations

import math
from dataclasses import dataclass

from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import setting
from us_sim.slicing.flow.doppler_settings import DopplerSettings


@dataclass(frozen=True)
class SpectrumSettings(DopplerSettings):
    """The gate, and how its spectrum is shown."""

    section = "spectrum"

    size: float = setting(
        Quantity("length", 5e-4, 0.02), "length of the gate along the beam", default=1.5e-3
    )
    angle_correction: float = setting(
        Quantity("angle", math.radians(-80), math.radians(80)),
        "between beam and vessel, as the sonographer sets it",
        default=0.0,
    )
    baseline: float = setting(
        Quantity("number", -0.9, 0.9),
        "of 0 m/s: by which fraction of the Nyquist velocity it is moved down",
        default=0.0,
    )
    dynamic_range: float = setting(
        Quantity("level", 10.0, 80.0), default=30.0, description="level from black to white"
    )
    sweep: float = setting(Quantity("time", 0.5, 20.0), "that the picture shows", default=4.0)
