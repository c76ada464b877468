"""Limits of a score, and words for it: what is read without SciPy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from us_sim.errors import ScoreError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting

CONTACT_FORCE = 0.1
"""N, from which the probe touches the skin; a sensor's noise is below it."""
STATES = {
    "to lift": "lift the probe off the skin to begin",
    "to do": "begins when the probe touches the skin",
    "running": "goes on",
    "passed": "passed",
    "not passed": "not passed",
    "void": "void",
}
"""Words for what became of an attempt."""
ANSWERS = ("compressible", "not compressible", "not seen")
"""Of a learner, on a point of a vein."""
NO_ANSWER = "-"
"""Likewise, where there is none yet."""
NO_THROMBUS = "none"
"""Of a learner, on where it is."""


@dataclass(frozen=True)
class ScoreSettings(Settings):
    """The limit that metrics of force are about."""

    error: ClassVar = ScoreError

    force_limit: float = setting(
        Quantity("force", 0.01, 1000.0), "of which the time above it is told", default=10.0
    )
