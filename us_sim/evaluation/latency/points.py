"""What one way to run the arm shows: one row of the file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from us_sim.evaluation.latency.cases import Case
from us_sim.evaluation.latency.usage import UsageOverTime
from us_sim.evaluation.row import Row

HAND = 0.1
"""m/s of a hand, with which a time becomes a way."""

Heard = Sequence[tuple[int, int]]
"""Stamps and times of arrival, ns."""


@dataclass(frozen=True)
class Point(Row):
    """A case, and what was measured."""

    case: Case
    heard: Mapping[str, Heard] = field(default_factory=dict)  # by topic, in their order
    recorded: int | None = None  # of the images that were heard; None without a recorder
    usage: Mapping[str, UsageOverTime] = field(default_factory=dict)  # by node
    scheduling: str = "ordinary"  # or realtime: what the nodes got
    throughput: float = float("nan")  # images a second, in lockstep
    failure: str = ""

    @property
    def title(self) -> str:
        """The case."""
        return str(self.case)

    @property
    def values(self) -> dict[str, object]:
        """The case's settings, then ms, counts, cores and MB."""
        case = self.case
        columns, rows = case.image
        return {
            "solver": case.solver,
            "nodes": case.nodes,
            "image": f"{columns}x{rows}",
            "placed": case.placed,
            "recorder": case.recorder,
            "viewer": case.viewer,
            "cores_busy": case.busy,
            "scheduling": self.scheduling,
            "seconds": case.seconds,
            "poses": len(self._heard("tracker/pose")),
            "images": len(self.images),
            "images_a_second": self.rate,
            "dropped": self.dropped,
            "not_recorded": self.lost,
            **{
                f"{topic.replace('/', '_')}_ms_{name}": self.latency(topic, percent)
                for topic in self.heard
                if topic != "tracker/pose"
                for name, percent in (("p50", 50), ("p99", 99), ("worst", 100))
            },
            "image_mm_p50": HAND * self.latency("ultrasound/image", 50),
            "image_mm_p99": HAND * self.latency("ultrasound/image", 99),
            **{f"cores_{node}": use.processor for node, use in self.usage.items()},
            "cores_all": sum(use.processor for use in self.usage.values()) or np.nan,
            "memory_mb_all": 1e-6 * sum(use.memory for use in self.usage.values()) or np.nan,
            "growth_mb_a_minute": self.growth,
            "failure": self.failure,
        }

    @property
    def images(self) -> Heard:
        """Those that came."""
        return self._heard("ultrasound/image")

    @property
    def rate(self) -> float:
        """Images a second."""
        if len(self.images) < 2:
            return self.throughput
        return (len(self.images) - 1) / (1e-9 * (self.images[-1][1] - self.images[0][1]))

    @property
    def dropped(self) -> int:
        """Poses between the first and the last image of which there is no image."""
        stamps = {stamp for stamp, _ in self.images}
        if not stamps:
            return 0
        poses = {stamp for stamp, _ in self._heard("tracker/pose")}
        return sum(min(stamps) <= stamp <= max(stamps) for stamp in poses - stamps)

    @property
    def lost(self) -> float:
        """Images that came here and are not in the recording."""
        return np.nan if self.recorded is None else len(self.images) - self.recorded

    @property
    def growth(self) -> float:
        """MB a minute of the process whose memory grows fastest."""
        grown = [use.growth for use in self.usage.values() if not np.isnan(use.growth)]
        return 1e-6 * max(grown) if grown else np.nan

    def ages(self, topic: str) -> NDArray[np.float64]:
        """ms from the tracker's pose to the arrival of each message."""
        return np.array([1e-6 * (came - stamp) for stamp, came in self._heard(topic)])

    def latency(self, topic: str, percent: float) -> float:
        """Percentile of these, ms; NaN where none came."""
        ages = self.ages(topic)
        return float(np.percentile(ages, percent)) if len(ages) else np.nan

    def _heard(self, topic: str) -> Heard:
        return self.heard.get(topic, ())
