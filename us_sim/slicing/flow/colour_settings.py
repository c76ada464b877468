"""The settings of colour Doppler."""

from __future__ import annotations

import math
from dataclasses import dataclass

from us_sim.errors import ProbeError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting

__all__ = ["ColourSettings"]


@dataclass(frozen=True)
class ColourSettings(Settings):
    """The colour box, and how velocities in it are estimated.

    Raises:
        ProbeError: a value is out of range, or the wall filter takes all velocities.
    """

    section = "colour"
    error = ProbeError
    live = True

    lateral: float = setting(
        Quantity("number", -0.5, 0.5),
        "middle of the box across the face, or the opening angle, as a fraction of that",
        default=0.0,
    )
    width: float = setting(
        Quantity("number", 0.02, 1.0), "of the box, as a fraction likewise", default=0.5
    )
    depth: float | None = setting(
        Quantity("length", 1e-3, 0.4), "of its middle; not given: the image's middle", default=None
    )
    height: float | None = setting(
        Quantity("length", 1e-3, 0.4), "of it; not given: half of the image", default=None
    )
    steering: float = setting(
        Quantity("angle", math.radians(-30), math.radians(30)),
        "of the beams towards +x of the probe; linear probes only",
        default=0.0,
    )
    nyquist_velocity: float = setting(
        Quantity("speed", 0.01, 5.0), "along the beam, at which colours turn over", default=0.25
    )
    wall_filter: float = setting(
        Quantity("speed", 0.0, 0.2), "along the beam, of what is halved as tissue", default=0.015
    )
    gain: float = setting(Quantity("level", -30.0, 30.0), "of faint flow", default=0.0)
    pulses: int = setting(
        Quantity("number", 3, 64), "along each beam; the more, the less noise", default=10
    )
    resolution: float = setting(
        Quantity("length", 0.0, 5e-3), "full width at half maximum", default=0.6e-3
    )
    persistence: float = setting(
        Quantity("number", 0.0, 0.95), "weight of the frames before", default=0.3
    )

    def check(self) -> None:
        """Refuse a wall filter that leaves nothing."""
        if self.wall_filter >= self.nyquist_velocity:
            raise self.refused(
                "wall_filter",
                f"{self.wall_filter:g} m/s is not below nyquist_velocity, "
                f"{self.nyquist_velocity:g} m/s: nothing would be left to show",
            )
