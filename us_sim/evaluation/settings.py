"""Options of `us-sim evaluate hand`, `us-sim evaluate slice` and `us-sim evaluate measured`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from us_sim.errors import SettingsError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting


@dataclass(frozen=True)
class HandSettings(Settings):
    """Motions other than those of the reports."""

    seed: int = setting(Quantity("number", 0, 2**31), "of all motions", default=1)


@dataclass(frozen=True)
class RecordedSweep(Settings):
    """A recorded sweep that images are compared with: both files, or none."""

    volume: Path | None = setting(description="volume compounded from --sweep", default=None)
    sweep: Path | None = setting(description="tracked sweep to compare images with", default=None)

    def check(self) -> None:
        """Refuse one file without the other."""
        if (self.volume is None) != (self.sweep is None):
            raise SettingsError(
                "--volume and --sweep belong together: give the tracked sweep and the volume that "
                "was compounded from it"
            )


@dataclass(frozen=True)
class MeasuredData(Settings):
    """Data that others measured."""

    data: Path | None = setting(
        description="folder with the folders of measured data; default: US_SIM_TEST_DATA's",
        default=None,
    )
