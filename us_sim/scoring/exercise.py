"""Exercises: what a learner shall do with the probe, read from YAML, and whether a scan did it.

>>> from us_sim.scoring.exercise import read_exercise
>>> exercise = read_exercise("compression")
>>> exercise.task.name, exercise.assigned.structure
('compression', 'vein')
"""

from __future__ import annotations

import os
from abc import abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.errors import ScoreError
from us_sim.geometry.pose import Placement
from us_sim.geometry.se3 import rotation_between
from us_sim.scoring.centre_line import CentreLine
from us_sim.scoring.metrics import Scan, Section
from us_sim.settings.choice import Chosen
from us_sim.settings.quantity import Quantity
from us_sim.settings.reading import Reader
from us_sim.settings.registry import EXERCISES
from us_sim.settings.setting import Settings, setting
from us_sim.settings.spelling import unknown
from us_sim.settings.text_files import read_yaml
from us_sim.share import shared_roots
from us_sim.slicing.settings import WALLS_TOUCH

_LENGTH, _TIME, _FORCE = Quantity("length", 1e-4, 1.0), Quantity("time", 0.1, 3600.0), "force"
_PART = Quantity("number", 0.0, 1.0)
_MM = 1e3


class Step(NamedTuple):
    """One thing to do, and what was seen of it."""

    what: str
    is_done: bool
    seen: str
    target: NDArray[np.float64] | None = None  # (3,) m in frame ``patient``, where it is to be done


class Task(Settings):
    """Base of what an exercise may ask for."""

    error: ClassVar = ScoreError
    section: ClassVar = "task"

    @property
    def structures(self) -> tuple[str, ...]:
        """Names of the vessels that the scene must have."""
        return ()

    @abstractmethod
    def steps(self, scan: Scan) -> Iterator[Step]:
        """Every thing that is to be done, for a scan that has the structures."""


@dataclass(frozen=True)
class Compression(Task):
    """Compress a vein point by point, as in an examination for thrombosis.

    Each point is closed completely, which a thrombus prevents: there it is enough to have pressed
    hard. Every 2 cm is the interval of Needleman et al., "Ultrasound for lower extremity deep
    venous thrombosis", Circulation 137 (2018).
    """

    structure: str = setting(description="vein to be compressed", default="vein")
    artery: str | None = setting(description="artery that must stay open", default=None)
    spacing: float = setting(_LENGTH, "between points along the vein", default=0.02)
    margin: float = setting(Quantity("length", 0.0, 1.0), "left out at both ends", default=0.008)
    tolerance: float = setting(_LENGTH, "from a point, within which it counts", default=0.005)
    closed: float = setting(
        _PART, "part of its area that a closed vein may keep", default=WALLS_TOUCH
    )
    open: float = setting(_PART, "part of its area that the artery must keep", default=0.5)
    enough: float = setting(
        Quantity(_FORCE, 0.1, 200.0),
        "after which a vein that is still open holds a thrombus",
        default=10.0,
    )

    @property
    def structures(self) -> tuple[str, ...]:
        """The vein, and the artery where one is named."""
        return (self.structure, *([self.artery] if self.artery else []))

    def points(self, length: float) -> NDArray[np.float64]:
        """(N,) m along a vein of that length, the first in the middle of what is over."""
        room = max(length - 2 * self.margin, 0.0)
        count = int(room / self.spacing + 1e-9) + 1
        return np.asarray(
            0.5 * length + self.spacing * (np.arange(count) - 0.5 * (count - 1)), np.float64
        )

    def steps(self, scan: Scan) -> Iterator[Step]:
        """A step for each point."""
        line = scan.lines[self.structure]
        for point in self.points(float(line.lengths[-1])).tolist():
            what = f"{self.structure} at {_MM * point:.0f} mm"
            yield Step(what, *self._seen(scan, point), line.at(point))

    def _seen(self, scan: Scan, point: float) -> tuple[bool, str]:
        section = scan.sections.get(self.structure)
        if section is None:
            return False, "missed"
        near = np.flatnonzero(
            (np.abs(section.along - point) <= self.tolerance) & np.isfinite(section.fraction)
        )
        if not len(near):
            return False, "missed"
        left = section.fraction[near]
        force = scan.force.at(section.times[near]) if scan.force else np.full(len(near), np.nan)
        if (left <= self.closed).any():
            first = int(np.argmax(left <= self.closed))
            artery = self._artery(scan, float(section.times[near[first]]))
            seen = f"closed{_newtons(force[first])}"
            if artery < self.open:
                return False, f"{seen}, and of the {self.artery} {100 * artery:.0f} % were left"
            return True, seen
        least = int(np.argmin(left))
        most = float(np.nanmax(force)) if np.isfinite(force).any() else 0.0
        seen = f"{100 * left[least]:.0f} % open{_newtons(force[least])}"
        begin, end = scan.thrombi.get(self.structure, (np.inf, -np.inf))
        if most < self.enough:
            return False, f"{seen}: press harder"
        is_there = begin - self.tolerance <= point <= end + self.tolerance
        return is_there, f"{seen}: {'a thrombus' if is_there else 'not closed'}"

    def _artery(self, scan: Scan, time: float) -> float:
        """The part of its area that the artery had; all where nobody knows."""
        section = scan.sections.get(self.artery or "")
        if section is None:
            return 1.0
        part = float(section.fraction[np.argmin(np.abs(section.times - time))])
        return part if np.isfinite(part) else 1.0


@dataclass(frozen=True)
class KeepForce(Task):
    """Press with one force and keep it."""

    force: float = setting(Quantity(_FORCE, 0.01, 200.0), "to press with", default=5.0)
    tolerance: float = setting(Quantity(_FORCE, 0.01, 200.0), "above and below", default=1.0)
    duration: float = setting(_TIME, "without leaving it", default=5.0)

    def steps(self, scan: Scan) -> Iterator[Step]:
        """One step."""
        what = f"{self.force:g} ± {self.tolerance:g} N for {self.duration:g} s"
        if scan.force is None:
            yield Step(what, False, "the recording has no force")
            return
        within = np.abs(scan.force.newtons - self.force) <= self.tolerance
        yield _held(what, scan.force.times, within, self.duration)


@dataclass(frozen=True)
class Centre(Task):
    """Bring a vessel to the middle of the image and hold it there."""

    structure: str = setting(description="vessel to be centred", default="vein")
    offset: float = setting(_LENGTH, "from the image's middle at most", default=0.003)
    duration: float = setting(_TIME, "without losing it", default=3.0)

    @property
    def structures(self) -> tuple[str, ...]:
        """The vessel."""
        return (self.structure,)

    def steps(self, scan: Scan) -> Iterator[Step]:
        """One step."""
        what = f"{self.structure} within {_MM * self.offset:g} mm for {self.duration:g} s"
        section = scan.sections.get(self.structure)
        if section is None:
            yield Step(what, False, "never in the image")
            return
        yield _held(what, section.times, _is_centred(section, self.offset), self.duration)


@dataclass(frozen=True)
class Follow(Task):
    """Follow a vessel, keeping it in the middle of the image."""

    structure: str = setting(description="vessel to be followed", default="vein")
    offset: float = setting(_LENGTH, "from the image's middle at most", default=0.005)
    margin: float = setting(Quantity("length", 0.0, 1.0), "left out at both ends", default=0.01)
    part: float = setting(_PART, "of the rest that has to be seen", default=0.9)

    @property
    def structures(self) -> tuple[str, ...]:
        """The vessel."""
        return (self.structure,)

    def steps(self, scan: Scan) -> Iterator[Step]:
        """One step: pieces of 2 mm that were passed between two images, or seen in one."""
        line = scan.lines[self.structure]
        pieces = np.arange(self.margin, line.lengths[-1] - self.margin, 0.002)
        seen = np.zeros(len(pieces), bool)
        section = scan.sections.get(self.structure)
        if section is not None:
            centred = _is_centred(section, self.offset)
            for k in np.flatnonzero(centred).tolist():
                last = k - 1 if k and centred[k - 1] else k
                low, high = sorted((section.along[last], section.along[k]))
                seen |= (pieces > low - 0.002) & (pieces < high + 0.002)
        part = float(seen.mean()) if len(seen) else 0.0
        what = f"{100 * self.part:.0f} % of the {self.structure} in the image's middle"
        yield Step(what, part >= self.part, f"{100 * part:.0f} %")


@dataclass(frozen=True)
class View(Task):
    """Find a standard view: a pose of the probe, with vessels that must be in the image."""

    pose: Placement = setting(description="of the probe, in frame patient")
    distance: float = setting(_LENGTH, "from its position at most", default=0.005)
    angle: float = setting(Quantity("angle", 1e-3, 3.15), "from its orientation", default=0.17)
    visible: tuple[str, ...] = setting(description="vessels in the image", default=())
    duration: float = setting(_TIME, "without leaving it", default=1.0)

    @property
    def structures(self) -> tuple[str, ...]:
        """The vessels that must be seen."""
        return self.visible

    def steps(self, scan: Scan) -> Iterator[Step]:
        """One step."""
        wanted, motion = self.pose.pose, scan.motion
        apart = np.linalg.norm(motion.positions - wanted.position, axis=1)
        turned = np.array(
            [
                np.linalg.norm(rotation_between(each, wanted.orientation))
                for each in motion.orientations
            ]
        )
        within = (apart <= self.distance) & (turned <= self.angle)
        for name in self.visible:
            section = scan.sections.get(name)
            if section is None:
                within[:] = False
                continue
            nearest = np.abs(section.times[:, None] - motion.times).argmin(axis=0)
            within &= np.nan_to_num(section.area)[nearest] > 0
        what = f"the view within {_MM * self.distance:g} mm and {np.rad2deg(self.angle):.0f}°"
        held = _held(f"{what} for {self.duration:g} s", motion.times, within, self.duration)
        best = int(np.argmin(apart / self.distance + turned / self.angle))
        near = f"nearest {_MM * apart[best]:.1f} mm and {np.rad2deg(turned[best]):.0f}°"
        yield held._replace(seen=f"{held.seen}; {near}", target=wanted.position)


@dataclass(frozen=True)
class Exercise(Settings):
    """An exercise: a task in words, and its settings."""

    error: ClassVar = ScoreError

    name: str = setting(description="of the exercise")
    task: Chosen = setting(choice=EXERCISES)
    description: str = setting(description="of what is to be done, for the learner", default="")
    scene: str | None = setting(description="scene that it is made for", default=None)

    @property
    def assigned(self) -> Any:
        """The task with its settings."""
        return self.task.settings(EXERCISES)

    def require(self, lines: Mapping[str, CentreLine]) -> None:
        """Refuse vessels of which some that the task needs are missing.

        Raises:
            ScoreError: one sentence with the structure.
        """
        for name in self.assigned.structures:
            if name not in lines:
                known = unknown(name, lines) if lines else f"{name!r} is not known"
                of = "the vessels of the scene" if lines else "a scan without a scene"
                raise ScoreError(f"exercise {self.name}: in {of} the structure {known}")

    def steps(self, scan: Scan) -> list[Step]:
        """Steps to be done, with what was seen of each.

        Raises:
            ScoreError: as `require`.
        """
        self.require(scan.lines)
        return list(self.assigned.steps(scan))


def read_exercise(name: str | Path) -> Exercise:
    """Read an exercise: a file, or the name of one in ``config/exercises``.

    Raises:
        ScoreError: it is not there, or a value in it cannot be used; one sentence.
    """
    path = Path(os.path.expanduser(name))
    if not path.is_file():
        known = {f.stem: f for r in shared_roots() for f in (r / "config/exercises").glob("*.yaml")}
        if str(name) not in known:
            raise ScoreError(f"exercise {unknown(str(name), sorted(known))}")
        path = known[str(name)]
    return Reader(str(path), None, ScoreError).read(Exercise, read_yaml(path, ScoreError))


def _newtons(force: float) -> str:
    return f" at {force:.1f} N" if np.isfinite(force) else ""


def _is_centred(section: Section, offset: float) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        return np.asarray(np.abs(section.lateral) <= offset)


def _held(what: str, times: NDArray[np.float64], within: ArrayLike, duration: float) -> Step:
    """A step of holding something for so long without a break."""
    longest = held = 0.0
    inside = np.asarray(within, bool)
    for step, was, now in zip(np.diff(times).tolist(), inside[:-1], inside[1:], strict=True):
        held = held + step if was and now else 0.0
        longest = max(longest, held)
    return Step(what, longest >= duration, f"{longest:.1f} s")
