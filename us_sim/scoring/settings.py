"""Limits of a score, and words for it: read without SciPy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from us_sim.errors import ScoreError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting

CONTACT_FORCE = 0.1  # N, from which the probe touches the skin; a sensor's noise is below it
STATES = {
    "to lift": "lift the probe off the skin to begin",
    "to do": "begins when the probe touches the skin",
    "running": "goes on",
    "passed": "passed",
    "not passed": "not passed",
    "void": "void",
}
"""Words for the states of an attempt."""
ANSWERS = ("compressible", "not compressible", "not seen")  # a learner's, on a point of a vein
NO_ANSWER = "-"  # stands for an answer that is not given yet
NO_THROMBUS = "none"  # a learner's answer where there is none


@dataclass(frozen=True)
class ScoreSettings(Settings):
    """The limit of force for the metrics."""

    error: ClassVar = ScoreError

    force_limit: float = setting(
        Quantity("force", 0.01, 1000.0), "the metrics give the time above it", default=10.0
    )
