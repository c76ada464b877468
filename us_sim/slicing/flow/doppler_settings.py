"""What colour and pulsed-wave Doppler are set with alike."""

from __future__ import annotations

import math
from dataclasses import dataclass

from us_sim.errors import ProbeError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting


@dataclass(frozen=True)
class DopplerSettings(Settings):
    """Beams and velocities of Doppler ultrasound.

    Raises:
        ProbeError: a value is out of range, or the wall filter takes all velocities.
    """

    error = ProbeError
    live = True

    lateral: float = setting(
        Quantity("number", -0.5, 0.5),
        "of the middle across the face, or the opening angle, as a fraction of that",
        default=0.0,
    )
    depth: float | None = setting(
        Quantity("length", 1e-3, 0.4), "of the middle; not given: the image's middle", default=None
    )
    follow: bool = setting(
        description="keep the middle on the vessel nearest to it in the image", default=False
    )
    steering: float = setting(
        Quantity("angle", math.radians(-30), math.radians(30)),
        "of the beams towards +x of the probe; linear probes only",
        default=0.0,
    )
    nyquist_velocity: float = setting(
        Quantity("speed", 0.01, 5.0), "along the beam, at which velocities turn over", default=0.3
    )
    wall_filter: float = setting(
        Quantity("speed", 0.0, 0.2), "along the beam, of what is halved as tissue", default=0.015
    )
    gain: float = setting(Quantity("level", -30.0, 30.0), "of the blood's echoes", default=0.0)

    def check(self) -> None:
        """Refuse a wall filter that leaves nothing."""
        if self.wall_filter >= self.nyquist_velocity:
            raise self.refused(
                "wall_filter",
                f"{self.wall_filter:g} m/s is not below nyquist_velocity, "
                f"{self.nyquist_velocity:g} m/s: nothing would be left to show",
            )
