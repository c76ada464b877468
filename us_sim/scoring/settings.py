"""Limits of a score: what all nodes read of it, and so without SciPy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from us_sim.errors import ScoreError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting


@dataclass(frozen=True)
class ScoreSettings(Settings):
    """Limits that metrics of force are about."""

    error: ClassVar = ScoreError

    force_limit: float = setting(
        Quantity("force", 0.01, 1000.0), "of which the time above it is told", default=10.0
    )
    contact_force: float = setting(
        Quantity("force", 1e-6, 100.0),
        "from which the probe is in contact; a sensor's noise is below it",
        default=0.1,
    )
