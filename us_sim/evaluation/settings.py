"""Options of `us-sim evaluate hand` and `us-sim evaluate measured`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting


@dataclass(frozen=True)
class HandSettings(Settings):
    """Motions other than those of the reports."""

    seed: int = setting(Quantity("number", 0, 2**31), "of all motions", default=1)


@dataclass(frozen=True)
class MeasuredData(Settings):
    """Data that others measured."""

    data: Path | None = setting(
        description="folder with the folders of measured data; default: US_SIM_TEST_DATA's",
        default=None,
    )
