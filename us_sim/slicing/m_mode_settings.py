"""The settings of M-mode."""

from __future__ import annotations

from dataclasses import dataclass

from us_sim.errors import ProbeError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting


@dataclass(frozen=True)
class MModeSettings(Settings):
    """The line, and how long it is shown.

    Raises:
        ProbeError: a value is out of range.
    """

    section = "m_mode"
    error = ProbeError
    live = True

    lateral: float = setting(
        Quantity("number", -0.5, 0.5),
        "of the line across the face, or the opening angle, as a fraction of that",
        default=0.0,
    )
    sweep: float = setting(Quantity("time", 0.5, 20.0), "that the picture shows", default=4.0)
