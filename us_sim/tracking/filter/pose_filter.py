"""The interface of filters of poses.

>>> from us_sim.tracking.filter.pose_filter import Unfiltered
>>> Unfiltered().lag
0.0
"""

from __future__ import annotations

from abc import ABC, abstractmethod

from us_sim.settings.registry import FILTERS
from us_sim.settings.setting import Settings
from us_sim.tracking.measurement import Measurement


class PoseFilter(ABC):
    """Takes measurements one by one, each newer than the one before, and returns better ones.

    A filtered measurement keeps its stamp: it is the filter's answer for that very moment.
    """

    @abstractmethod
    def update(self, measurement: Measurement) -> Measurement:
        """The measurement with its pose filtered."""

    @abstractmethod
    def reset(self) -> None:
        """Forget everything: the next measurement is the first."""

    @property
    @abstractmethod
    def lag(self) -> float:
        """s by which, as the filter is set now, its position is behind a uniform motion."""

    @property
    @abstractmethod
    def rotation_lag(self) -> float:
        """s by which, as the filter is set now, its rotation is behind a uniform turn."""

    @abstractmethod
    def lag_at(self, frequency: float) -> float:
        """s by which, as the filter is set now, its position is behind a sway at ``frequency``."""


class Unfiltered(PoseFilter):
    """Poses as they were measured."""

    lag = 0.0
    rotation_lag = 0.0

    def __init__(self, settings: Settings | None = None) -> None:
        """There is nothing to set."""

    def update(self, measurement: Measurement) -> Measurement:
        """The measurement itself."""
        return measurement

    def reset(self) -> None:
        """Nothing is kept."""

    def lag_at(self, frequency: float) -> float:  # noqa: ARG002
        """s, no lag."""
        return 0.0


def create_filter(name: str, settings: Settings | None = None) -> PoseFilter:
    """The filter of that name, with its settings; what is not named is not imported.

    Raises:
        TrackingError: there is no filter of that name.
    """
    filter_class = FILTERS.load(name)
    made: PoseFilter = filter_class(settings or FILTERS.settings(name)())
    return made
