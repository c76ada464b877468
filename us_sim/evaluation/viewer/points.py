"""What one way to look at the arm shows: one row of the file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from us_sim.evaluation.latency.usage import UsageOverTime
from us_sim.evaluation.row import Row
from us_sim.evaluation.viewer.cases import Case


@dataclass(frozen=True)
class Point(Row):
    """A case, and what was measured."""

    case: Case
    made: float = np.nan  # images a second of the simulator
    skipped: float = np.nan  # of 100 poses those without an image
    ages: Sequence[float] = ()  # ms, from a pose to its image in the graph
    shown: float = np.nan  # images a second in the page that gets the fewest
    delay_median: float = np.nan  # ms, from what a person does to the image in the page
    delay_p99: float = np.nan
    delays: float = np.nan  # how many of these there are
    started: float = np.nan  # s, from the command to the first image in a page
    opened: float = np.nan  # s, from opening the page in a browser to its first image
    usage: Mapping[str, UsageOverTime] = field(default_factory=dict)  # by what the process is
    failure: str = ""

    @property
    def title(self) -> str:
        """The case."""
        return str(self.case)

    @property
    def values(self) -> dict[str, object]:
        """The case, then images a second, ms, s, cores and MB."""
        use = self.usage
        return {
            "case": str(self.case),
            "seconds": self.case.seconds,
            "images_a_second_made": self.made,
            "poses_skipped_percent": self.skipped,
            "image_age_ms_p50": self.age(50),
            "image_age_ms_p99": self.age(99),
            "images_a_second_shown": self.shown,
            "delay_ms_median": self.delay_median,
            "delay_ms_p99": self.delay_p99,
            "delays": self.delays,
            "start_s": self.started,
            "page_opened_s": self.opened,
            "cores_viewer": self.cores("viewer"),
            "cores_browser": self.cores("browser"),
            "memory_mb_viewer": 1e-6 * use["viewer"].memory if "viewer" in use else np.nan,
            "memory_mb_browser": 1e-6 * use["browser"].memory if "browser" in use else np.nan,
            "growth_mb_a_minute_viewer": self.growth("viewer"),
            "growth_mb_a_minute_browser": self.growth("browser"),
            "failure": self.failure,
        }

    def age(self, percent: float) -> float:
        """Percentile of the images' ages, ms."""
        return float(np.percentile(self.ages, percent)) if len(self.ages) else np.nan

    def cores(self, name: str) -> float:
        """Processor time over time of the processes of a name."""
        return self.usage[name].processor if name in self.usage else np.nan

    def growth(self, name: str) -> float:
        """MB a minute after the first minute; NaN in a short run."""
        return 1e-6 * self.usage[name].growth if name in self.usage else np.nan
