"""The metrics of a scan, each with its name, the roles it is of, and its unit, as PerkTutor has it.

Motion is told in mm and s, as in PerkTutor's tables, which have none of force: those metrics are
integrals over time, stated below.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import ScoreError
from us_sim.scoring.centre_line import CentreLine
from us_sim.scoring.motion import Motion
from us_sim.scoring.settings import ScoreSettings

_Array = NDArray[np.float64]
_MM, _MM2, _DEGREES = 1e3, 1e6, float(np.rad2deg(1.0))


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
        """The value as a person reads it; - where it is not known."""
        if not np.isfinite(self.value):
            return "-"
        return f"{self.value:.0f}" if self.unit == "count" else f"{self.value:.6g}"


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

    def at(self, times: _Array) -> _Array:
        """The force at other times, linear in between; NaN before the first and after the last."""
        found = np.interp(times, self.times, self.newtons, left=np.nan, right=np.nan)
        return np.asarray(found, np.float64)


@dataclass(frozen=True)
class Section:
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
    """Everything of a recording that is scored; times are seconds since its first pose."""

    motion: Motion  # of the probe in frame ``patient``
    force: Force | None = None
    sections: Mapping[str, Section] = field(default_factory=dict)  # by the vessel's name
    lines: Mapping[str, CentreLine] = field(default_factory=dict)  # of all vessels of the scene
    # (from, to) m along the line of a vessel, by its name, where a thrombus is in it
    thrombi: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    width: float | None = None  # m, of the image, so of the probe's face
    frozen: int | None = None  # images that were frozen
    missing: tuple[str, ...] = ()  # metrics that cannot be told, and why, in sentences


def metrics_of(scan: Scan, settings: ScoreSettings | None = None) -> Iterator[Metric]:
    """All metrics that the scan has data for, in the order of a report."""
    settings = settings or ScoreSettings()
    yield from _of_motion(scan.motion)
    if scan.force is not None:
        yield from _of_force(scan.force, settings)
        if scan.width is not None:
            touching = scan.force.at(scan.motion.times) >= settings.contact_force
            area = _MM2 * scan.motion.face_area(scan.width, touching)
            yield Metric("Area Scanned in Contact", "mm^2", area)
    if scan.frozen is not None:
        yield Metric("Images Frozen", "count", scan.frozen)
    for name, section in scan.sections.items():
        yield from _of_section(name, section)


def _of_motion(motion: Motion) -> Iterator[Metric]:
    speeds, turns = _MM * motion.speeds, _DEGREES * motion.angular_speeds
    yield Metric("Elapsed Time", "s", motion.elapsed_time())
    yield Metric("Path Length", "mm", _MM * motion.path_length())
    yield Metric("Rotation Total", "deg", float(turns @ motion.steps))
    yield Metric("Translational Actions", "count", motion.translational_actions())
    yield Metric("Rotational Actions", "count", motion.rotational_actions())
    yield Metric("Average Velocity", "mm/s", float(speeds.mean()))
    yield Metric("Peak Velocity", "mm/s", float(speeds.max()))
    if len(motion) > 2:
        accelerations = _MM * np.linalg.norm(motion.accelerations, axis=1)
        yield Metric("Average Acceleration", "mm/s^2", float(accelerations.mean()))
        yield Metric("Peak Acceleration", "mm/s^2", float(accelerations.max()))
    if len(motion) > 3:
        # PerkTutor's table says mm/s^3, which is the unit of jerk and not of this integral's root.
        yield Metric("Motion Smoothness", "mm/s^2.5", _MM * motion.motion_smoothness())
        yield Metric("Dimensionless Squared Jerk", "1", motion.dimensionless_jerk())


def _of_force(force: Force, settings: ScoreSettings) -> Iterator[Metric]:
    """Means over time, the force linear between two samples, which count as the later one."""
    steps = np.diff(force.times)
    during = 0.5 * (force.newtons[1:] + force.newtons[:-1])
    touching = force.newtons[1:] >= settings.contact_force
    contact = float(steps[touching].sum())
    yield Metric("Time in Contact", "s", contact)
    if contact > 0:
        mean = float(during[touching] @ steps[touching]) / contact
        yield Metric("Mean Probe Force in Contact", "N", mean)
    yield Metric("Peak Probe Force", "N", float(force.newtons.max()))
    above = float(steps[force.newtons[1:] > settings.force_limit].sum())
    yield Metric(f"Time above {settings.force_limit:g} N", "s", above)
    yield Metric("Force Impulse", "N s", float(during @ steps))


def _of_section(name: str, section: Section) -> Iterator[Metric]:
    fraction = section.fraction
    known = np.isfinite(fraction)
    if not known.any():
        return
    yield Metric("Mean Area at Rest", "mm^2", _MM2 * float(section.at_rest[known].mean()), name)
    yield Metric("Smallest Area", "mm^2", _MM2 * float(section.area[known].min()), name)
    yield Metric("Smallest Part of the Area at Rest", "%", 100 * float(fraction[known].min()), name)
    angles = section.angle[np.isfinite(section.angle)]
    if len(angles):
        yield Metric("Mean Angle to the Vessel", "deg", _DEGREES * float(angles.mean()), name)
