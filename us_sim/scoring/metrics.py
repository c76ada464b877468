"""The metrics of a scan, each with its name, the roles it is of, and its unit, as PerkTutor has it.

Motion is told in mm and s, as in PerkTutor's tables, which have none of force: those metrics are
integrals over time, stated below.
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
from us_sim.scoring.motion import ACTION_SPEED, ACTION_TURN, ActionCounter, Motion
from us_sim.scoring.settings import CONTACT_FORCE, ScoreSettings

_Array = NDArray[np.float64]
_MM, _MM2, _DEGREES = 1e3, 1e6, float(np.rad2deg(1.0))
DEFINITIONS = {
    "Elapsed Time": "from the first pose to the last",
    "Path Length": "sum of the steps between poses",
    "Rotation Total": "sum of the shorter turns between poses",
    "Translational Actions": "times that the probe's face moved faster than 50 mm/s",
    "Rotational Actions": "times that the probe turned faster than 50 °/s",
    "Motion Smoothness": "root of the integral of the squared jerk; less is smoother",
    "Dimensionless Squared Jerk": "integral of the squared jerk × time⁵ / path length²",
    "Time in Contact": "while the force is at least that of contact",
    "Force Impulse": "integral of the force over time",
    "Area Scanned in Contact": "area of the skin over which the face slid while in contact",
    "Smallest Part of the Area at Rest": "of the vessel in the same plane without pressure",
    "Mean Angle to the Vessel": "between its centre line and the image; 90° is straight across",
}
"""Of metrics whose name does not say all, by their names."""


@dataclass(frozen=True)
class Metric:
    """One value of a table."""

    name: str
    unit: str
    value: float
    structure: str = ""  # that it is of, beside the probe

    @property
    def roles(self) -> str:
        """The objects that it is of, as PerkTutor writes them."""
        return f"Any = Probe, Structure = {self.structure}" if self.structure else "Any = Probe"

    @property
    def label(self) -> str:
        """Name, the structure that it is of, and unit."""
        return f"{self.name}{self.structure and f' of {self.structure}'}, {self.unit}"

    @property
    def text(self) -> str:
        """The value as a program reads it; - where it is not known."""
        return self._written(6)

    @property
    def brief(self) -> str:
        """The value as a person reads it, in three digits."""
        return self._written(3)

    def _written(self, digits: int) -> str:
        if not np.isfinite(self.value):
            return "-"
        return f"{self.value:.0f}" if self.unit == "count" else f"{self.value:.{digits}g}"


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
        """The force at other times, linear in between; NaN before the first and after the last."""
        found = np.interp(times, self.times, self.newtons, left=np.nan, right=np.nan)
        return np.asarray(found, np.float64)


@dataclass(frozen=True)
class VesselSection:
    """A vessel's cross-section in the image over time; NaN where the image does not show it."""

    times: _Array  # (K,) s
    area: _Array  # (K,) m², in the image
    at_rest: _Array  # (K,) m², in the same plane of the tissue at rest
    along: _Array  # (K,) m, of the place on the vessel's centre line
    angle: _Array  # (K,) rad, between the centre line and the image plane; a right angle is across
    lateral: _Array  # (K,) m, of the vessel's middle at rest from the middle of the image

    @property
    def fraction(self) -> _Array:
        """(K,) the part of the area at rest that is open."""
        return self.area / self.at_rest


@dataclass(frozen=True)
class Scan:
    """Everything of a recording that is scored, or a piece of it; times are s since its first pose.

    A piece that follows another begins with samples of it, whose times are not after ``since``:
    three poses, a force and a section, as far as there are any.
    """

    motion: Motion  # of the probe in frame ``patient``
    force: Force | None = None
    sections: Mapping[str, VesselSection] = field(default_factory=dict)  # by the vessel's name
    lines: Mapping[str, CentreLine] = field(default_factory=dict)  # of all vessels of the scene
    # (from, to) m along the line of a vessel, by its name, where a thrombus is in it
    thrombi: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    width: float | None = None  # m, of the image, so of the probe's face
    frozen: int | None = None  # images that were frozen
    missing: tuple[str, ...] = ()  # metrics that cannot be told, and why, in sentences
    since: float = -np.inf  # s

    def select_new(self, times: _Array, *values: _Array) -> list[_Array]:
        """The last of each values, for as many samples as are new by their times."""
        count = int(np.count_nonzero(times > self.since))
        return [each[max(len(each) - count, 0) :] for each in values]


def compute_metrics(scan: Scan, settings: ScoreSettings | None = None) -> Iterator[Metric]:
    """All metrics that the scan has data for, in the order of a report."""
    return Tally(settings).add_scan(scan).list_metrics()


class Tally:
    """Metrics of a scan that is added whole, or in pieces one after another."""

    def __init__(self, settings: ScoreSettings | None = None) -> None:
        self._settings = settings or ScoreSettings()
        self._sums: defaultdict[str, float] = defaultdict(float)
        self._extremes: defaultdict[str, float] = defaultdict(float)
        self._translation, self._rotation = ActionCounter(), ActionCounter()
        self._of_vessels: dict[str, Tally] = {}
        self._is_touching = False  # at the last pose
        self._frozen: int | None = None

    def add_scan(self, scan: Scan) -> Tally:
        """Take the samples that are new."""
        self._add_motion(scan)
        if scan.force is not None:
            self._add_force(scan, scan.force)
        else:
            self._is_touching = False
        for name, section in scan.sections.items():
            self._of_vessels.setdefault(name, Tally())._add_section(scan, section)
        self._frozen = scan.frozen
        return self

    def list_metrics(self) -> Iterator[Metric]:
        """All that there are data for, in the order of a report."""
        yield from self._of_motion()
        if "impulse" in self._sums:
            yield from self._of_force()
        if "area" in self._sums:
            yield Metric("Area Scanned in Contact", "mm^2", _MM2 * self._sums["area"])
        if self._frozen is not None:
            yield Metric("Images Frozen", "count", self._frozen)
        for name, tally in self._of_vessels.items():
            yield from tally._of_section(name)

    def _sum(self, **values: Any) -> None:
        for name, value in values.items():
            self._sums[name] += float(value)

    def _peak(self, name: str, values: _Array) -> None:
        """Keep the largest; none is below 0."""
        self._extremes[name] = max(self._extremes[name], float(values.max(initial=0.0)))

    def _add_motion(self, scan: Scan) -> None:
        motion = scan.motion
        times, steps, speeds, turns, jerks, accelerations = scan.select_new(
            motion.times,
            motion.times[1:],
            motion.steps,
            motion.speeds,
            motion.angular_speeds,
            motion.squared_jerks,
            np.linalg.norm(motion.accelerations, axis=1),
        )
        self._sum(steps=len(steps), time=steps.sum(), path=speeds @ steps, turn=turns @ steps)
        self._sum(speed=speeds.sum(), jerks=len(jerks), jerk=jerks.sum())
        self._sum(accelerations=len(accelerations), acceleration=accelerations.sum())
        self._peak("speed", speeds)
        self._peak("acceleration", accelerations)
        if len(steps):
            begin = float(times[0] - steps[0])
            self._translation.add_steps(times, speeds > ACTION_SPEED, begin)
            self._rotation.add_steps(times, turns > ACTION_TURN, begin)

    def _of_motion(self) -> Iterator[Metric]:
        total = self._sums
        yield Metric("Elapsed Time", "s", total["time"])
        yield Metric("Path Length", "mm", _MM * total["path"])
        yield Metric("Rotation Total", "deg", _DEGREES * total["turn"])
        yield Metric("Translational Actions", "count", self._translation.count)
        yield Metric("Rotational Actions", "count", self._rotation.count)
        yield Metric("Average Velocity", "mm/s", _MM * total["speed"] / total["steps"])
        yield Metric("Peak Velocity", "mm/s", _MM * self._extremes["speed"])
        if total["accelerations"]:
            mean = total["acceleration"] / total["accelerations"]
            yield Metric("Average Acceleration", "mm/s^2", _MM * mean)
            yield Metric("Peak Acceleration", "mm/s^2", _MM * self._extremes["acceleration"])
        if total["jerks"]:
            # PerkTutor's table says mm/s^3: the unit of jerk and not of this integral's root. It is
            # larger the less smooth the motion, and of a noisy or fast tracker mostly noise.
            yield Metric("Motion Smoothness", "mm/s^2.5", _MM * float(np.sqrt(total["jerk"])))
            # 720 for a straight movement of minimum jerk, whatever its length and time.
            scale = total["time"] ** 5 / total["path"] ** 2 if total["path"] > 0 else np.nan
            yield Metric("Dimensionless Squared Jerk", "1", total["jerk"] * scale)

    def _add_force(self, scan: Scan, force: Force) -> None:
        """Means over time, the force linear between two samples, which count as the later one."""
        steps, during, ends = scan.select_new(
            force.times,
            np.diff(force.times),
            0.5 * (force.newtons[1:] + force.newtons[:-1]),
            force.newtons[1:],
        )
        touching = ends >= CONTACT_FORCE
        self._sum(contact=steps[touching].sum(), pressed=during[touching] @ steps[touching])
        self._sum(above=steps[ends > self._settings.force_limit].sum(), impulse=during @ steps)
        self._peak("force", force.newtons)
        if scan.width is not None:
            motion = scan.motion
            at_poses = force.interpolate_at(motion.times) >= CONTACT_FORCE
            old = len(motion) - np.count_nonzero(motion.times > scan.since)
            at_poses[:old] = False
            if old:
                at_poses[old - 1] = self._is_touching
            self._is_touching = bool(at_poses[-1])
            self._sum(area=motion.compute_face_area(scan.width, at_poses))

    def _of_force(self) -> Iterator[Metric]:
        total = self._sums
        yield Metric("Time in Contact", "s", total["contact"])
        if total["contact"] > 0:
            mean = total["pressed"] / total["contact"]
            yield Metric("Mean Probe Force in Contact", "N", mean)
        yield Metric("Peak Probe Force", "N", self._extremes["force"])
        yield Metric(f"Time above {self._settings.force_limit:g} N", "s", total["above"])
        yield Metric("Force Impulse", "N s", total["impulse"])

    def _add_section(self, scan: Scan, section: VesselSection) -> None:
        area, rest, angle = scan.select_new(
            section.times, section.area, section.at_rest, section.angle
        )
        known = np.isfinite(area / rest)
        angles = angle[np.isfinite(angle)]
        self._sum(known=known.sum(), rest=rest[known].sum())
        self._sum(angles=len(angles), angle=angles.sum())
        for name, values in (("area", area[known]), ("part", (area / rest)[known])):
            self._extremes[name] = min(self._extremes.get(name, np.inf), values.min(initial=np.inf))

    def _of_section(self, name: str) -> Iterator[Metric]:
        total = self._sums
        if not total["known"]:
            return
        mean = total["rest"] / total["known"]
        yield Metric("Mean Area at Rest", "mm^2", _MM2 * mean, name)
        yield Metric("Smallest Area", "mm^2", _MM2 * self._extremes["area"], name)
        yield Metric("Smallest Part of the Area at Rest", "%", 100 * self._extremes["part"], name)
        if total["angles"]:
            mean = total["angle"] / total["angles"]
            yield Metric("Mean Angle to the Vessel", "deg", _DEGREES * mean, name)
