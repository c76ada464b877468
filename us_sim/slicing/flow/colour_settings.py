"""The settings of colour Doppler."""

from __future__ import annotations

from dataclasses import dataclass

from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import setting
from us_sim.slicing.flow.doppler_settings import DopplerSettings


@dataclass(frozen=True)
class ColourSettings(DopplerSettings):
    """The colour box, and how velocities in it are estimated."""

    section = "colour"

    width: float = setting(
        Quantity("number", 0.02, 1.0),
        "of the box across the face, or the opening angle, as a fraction of that",
        default=0.5,
    )
    height: float | None = setting(
        Quantity("length", 1e-3, 0.4),
        "of the box along the beams; not given: half of the image",
        default=None,
    )
    pulses: int = setting(
        Quantity("number", 3, 64), "along each beam; the more, the less noise", default=10
    )
    resolution: float = setting(
        Quantity("length", 0.0, 5e-3), "full width at half maximum", default=0.6e-3
    )
    persistence: float = setting(
        Quantity("number", 0.0, 0.95), "weight of the frames before", default=0.3
    )
