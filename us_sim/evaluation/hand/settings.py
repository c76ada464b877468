"""What of the evaluation may be chosen: each field is an option of the command."""

from __future__ import annotations

from dataclasses import dataclass

from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting


@dataclass(frozen=True)
class HandSettings(Settings):
    """Motions other than those of the reports."""

    seed: int = setting(Quantity("number", 0, 2**31), "of all motions", default=1)
