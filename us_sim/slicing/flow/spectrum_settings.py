"""The settings of pulsed-wave Doppler."""

from __future__ import annotations

import math
from dataclasses import dataclass

from us_sim.errors import ProbeError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting

__all__ = ["SpectrumSettings"]


@dataclass(frozen=True)
class SpectrumSettings(Settings):
    """The gate, and how its spectrum is shown.

    Raises:
        ProbeError: a value is out of range, or the wall filter takes all velocities.
    """

    section = "spectrum"
    error = ProbeError
    live = True

    lateral: float = setting(
        Quantity("number", -0.5, 0.5),
        "of the gate's beam across the face, or the opening angle, as a fraction of that",
        default=0.0,
    )
    depth: float | None = setting(
        Quantity("length", 1e-3, 0.4),
        "of the gate's middle; not given: the image's middle",
        default=None,
    )
    size: float = setting(
        Quantity("length", 5e-4, 0.02), "length of the gate along the beam", default=1.5e-3
    )
    steering: float = setting(
        Quantity("angle", math.radians(-30), math.radians(30)),
        "of the beam towards +x of the probe; linear probes only",
        default=0.0,
    )
    angle_correction: float = setting(
        Quantity("angle", math.radians(-80), math.radians(80)),
        "between beam and vessel, as the sonographer sets it",
        default=0.0,
    )
    nyquist_velocity: float = setting(
        Quantity("speed", 0.01, 5.0), "along the beam, at which velocities turn over", default=0.5
    )
    baseline: float = setting(
        Quantity("number", -0.9, 0.9),
        "of 0 m/s: by which fraction of the Nyquist velocity it is moved down",
        default=0.0,
    )
    wall_filter: float = setting(
        Quantity("speed", 0.0, 0.2), "along the beam, of what is halved as tissue", default=0.01
    )
    gain: float = setting(Quantity("level", -30.0, 30.0), default=0.0, description="of the echoes")
    dynamic_range: float = setting(
        Quantity("level", 10.0, 80.0), default=30.0, description="level from black to white"
    )
    sweep: float = setting(Quantity("time", 0.5, 20.0), "that the picture shows", default=4.0)

    def check(self) -> None:
        """Refuse a wall filter that leaves nothing."""
        if self.wall_filter >= self.nyquist_velocity:
            raise self.refused(
                "wall_filter",
                f"{self.wall_filter:g} m/s is not below nyquist_velocity, "
                f"{self.nyquist_velocity:g} m/s: nothing would be left to show",
            )
