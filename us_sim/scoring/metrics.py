"""Metrics of a scan, each with its name, roles and unit, as PerkTutor has them.

Motion is given in mm and s, as in PerkTutor's tables. These have no metrics of force; ours are
means and times over the force, linear between two samples.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import ScoreError
from us_sim.scoring.centre_line import CentreLine
from us_sim.scoring.motion import Motion
from us_sim.scoring.settings import CONTACT_FORCE, ScoreSettings

_Array = NDArray[np.float64]
_FAR = 0.25  # s from a sample of the force, from which on it is not known
_MM, _MM2, _DEGREES = 1e3, 1e6, float(np.rad2deg(1.0))

DEFINITIONS = {
    "Elapsed Time": "from the first pose to the last",
    "Path Length": "sum of the steps between poses",
    "Rotation Total": "sum of the shorter turns between poses",
    "Time in Contact": f"while the force is at least {CONTACT_FORCE:g} N",
    "Smallest Part of the Area at Rest": "of the vessel in the same plane without pressure",
}
"""Definitions of metrics whose names do not say all."""


@dataclass(frozen=True)
class Metric:
    """One value of a table."""

    name: str
    unit: str
    value: float
    structure: str = ""  # that it is of, beside the probe

    @property
    def label(self) -> str:
        """Name, the structure that it is of, and unit."""
        return f"{self.name}{self.structure and f' of {self.structure}'}, {self.unit}"

    def format(self, digits: int = 6) -> str:
        """Return the value as a program reads it, a person in 3 digits; - where it is not known."""
        return f"{self.value:.{digits}g}" if np.isfinite(self.value) else "-"


@dataclass(frozen=True)
class Force:
    """Magnitude of the force on the probe over time.

    Raises:
        ScoreError: the arrays are not of the same K samples, or fewer than two.
    """

    times: _Array  # (K,) s, rising
    newtons: _Array  # (K,)

    def __post_init__(self) -> None:
        if self.times.shape != self.newtons.shape or len(self.times) < 2:
            raise ScoreError("a force over time needs two samples, and a time for each")

    def interpolate_at(self, times: _Array) -> _Array:
        """Interpolate the force (N) linearly; NaN before, after, and far from all samples."""
        found = np.interp(times, self.times, self.newtons, left=np.nan, right=np.nan)
        after = np.searchsorted(self.times, times).clip(1, len(self.times) - 1)
        apart = np.minimum(times - self.times[after - 1], self.times[after] - times)
        return np.where(apart <= _FAR, found, np.nan)


@dataclass(frozen=True)
class VesselSection:
    """A vessel's cross-section in the image over time; NaN where the image does not show it."""

    times: _Array  # (K,) s
    area: _Array  # (K,) m², in the image
    at_rest: _Array  # (K,) m², in the same plane of the tissue at rest
    along: _Array  # (K,) m, of the place on the vessel's centre line
    lateral: _Array  # (K,) m, of the vessel's middle at rest from the middle of the image
    depth: _Array  # (K,) m, of the probe below the skin

    @property
    def fraction(self) -> _Array:
        """(K,) the part of the area at rest that is open."""
        return self.area / self.at_rest


@dataclass(frozen=True)
class Scan:
    """Everything of a recording that is scored, or a piece of it; times are s since its first pose.

    A piece that follows another begins with the last pose, force and section of that one, as far
    as there are any: their times are not after ``since``.
    """

    motion: Motion  # of the probe in frame ``patient``
    force: Force | None = None
    sections: Mapping[str, VesselSection] = field(default_factory=dict)  # by the vessel's name
    lines: Mapping[str, CentreLine] = field(default_factory=dict)  # of all vessels of the scene
    # (from, to) m along the line of a vessel, by its name, where a thrombus is in it
    thrombi: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    missing: tuple[str, ...] = ()  # metrics without data, and why, in sentences
    since: float = -np.inf  # s

    def select_new(self, times: _Array, *values: _Array) -> list[_Array]:
        """Return the last of each values, as many as there are times after ``since``."""
        count = int(np.count_nonzero(times > self.since))
        return [each[max(len(each) - count, 0) :] for each in values]


class Tally:
    """Metrics of a scan that is added whole, or in pieces one after another."""

    def __init__(self, settings: ScoreSettings | None = None) -> None:
        self._settings = settings or ScoreSettings()
        self._sums: defaultdict[str, float] = defaultdict(float)
        self._fastest = self._strongest = 0.0  # m/s and N
        self._vessels: defaultdict[str, _VesselTally] = defaultdict(_VesselTally)

    def add_scan(self, scan: Scan) -> Tally:
        """Add the samples that are new."""
        motion = scan.motion
        steps, speeds, turns = scan.select_new(
            motion.times, motion.steps, motion.speeds, motion.angular_speeds
        )
        self._sum(steps=len(steps), time=steps.sum(), speed=speeds.sum())
        self._sum(path=speeds @ steps, turn=turns @ steps)
        self._fastest = max(self._fastest, float(speeds.max(initial=0.0)))
        if scan.force is not None:
            self._add_force(scan, scan.force)
        for name, section in scan.sections.items():
            self._vessels[name].add_section(scan, section)
        return self

    def list_metrics(self) -> Iterator[Metric]:
        """Yield all metrics that there are data for, in the order of a report."""
        total = self._sums
        yield Metric("Elapsed Time", "s", total["time"])
        yield Metric("Path Length", "mm", _MM * total["path"])
        yield Metric("Rotation Total", "deg", _DEGREES * total["turn"])
        yield Metric("Average Velocity", "mm/s", _MM * total["speed"] / max(total["steps"], 1))
        yield Metric("Peak Velocity", "mm/s", _MM * self._fastest)
        if "contact" in total:
            yield Metric("Time in Contact", "s", total["contact"])
            if total["contact"] > 0:
                mean = total["pressed"] / total["contact"]
                yield Metric("Mean Probe Force in Contact", "N", mean)
            yield Metric("Peak Probe Force", "N", self._strongest)
            yield Metric(f"Time above {self._settings.force_limit:g} N", "s", total["above"])
        for name, vessel in self._vessels.items():
            yield from vessel.list_metrics(name)

    def _sum(self, **values: Any) -> None:
        for name, value in values.items():
            self._sums[name] += float(value)

    def _add_force(self, scan: Scan, force: Force) -> None:
        """Add steps between two samples; a step counts as being in contact where its end is."""
        steps, during, ends = scan.select_new(
            force.times,
            np.diff(force.times),
            0.5 * (force.newtons[1:] + force.newtons[:-1]),
            force.newtons[1:],
        )
        touching = ends >= CONTACT_FORCE
        self._sum(contact=steps[touching].sum(), pressed=during[touching] @ steps[touching])
        self._sum(above=steps[ends > self._settings.force_limit].sum())
        self._strongest = max(self._strongest, float(force.newtons.max()))


class _VesselTally:
    """Areas of a vessel, of images in which they are known at rest, too."""

    def __init__(self) -> None:
        self._count, self._rest = 0, 0.0  # images, and the sum of their areas (m²) at rest
        self._area = self._part = np.inf  # m², the smallest, and of the area at rest

    def add_section(self, scan: Scan, section: VesselSection) -> None:
        area, rest = scan.select_new(section.times, section.area, section.at_rest)
        known = np.isfinite(area / rest)
        area, rest = area[known], rest[known]
        self._count, self._rest = self._count + len(rest), self._rest + float(rest.sum())
        self._area = min(self._area, area.min(initial=np.inf))
        self._part = min(self._part, (area / rest).min(initial=np.inf))

    def list_metrics(self, name: str) -> Iterator[Metric]:
        if self._count:
            yield Metric("Mean Area at Rest", "mm^2", _MM2 * (self._rest / self._count), name)
            yield Metric("Smallest Area", "mm^2", _MM2 * self._area, name)
            yield Metric("Smallest Part of the Area at Rest", "%", 100 * self._part, name)
