"""Filters of poses: what each of them does, and the one that a scene asks for.

>>> from us_sim.tracking.filter.settings import FilterSettings
>>> from us_sim.tracking.filter.pose_filter import make_filter
>>> round(1e3 * make_filter(FilterSettings("one_euro", minimum_cutoff=2.0)).lag)  # ms, at rest
80
>>> make_filter(FilterSettings("kalman")).lag
0.0
"""

from __future__ import annotations

from abc import ABC, abstractmethod

from us_sim.tracking.filter.settings import FilterSettings
from us_sim.tracking.measurement import Measurement

__all__ = ["PoseFilter", "Unfiltered", "make_filter"]


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

    def update(self, measurement: Measurement) -> Measurement:
        """The measurement itself."""
        return measurement

    def reset(self) -> None:
        """Nothing is kept."""

    def lag_at(self, frequency: float) -> float:  # noqa: ARG002
        """None."""
        return 0.0


def make_filter(settings: FilterSettings) -> PoseFilter:
    """The filter that the settings name; what is not named is not imported."""
    if settings.method == "one_euro":
        from us_sim.tracking.filter.one_euro import OneEuro

        return OneEuro(settings)
    if settings.method == "kalman":
        from us_sim.tracking.filter.kalman import ConstantVelocityKalman

        return ConstantVelocityKalman(settings)
    return Unfiltered()
