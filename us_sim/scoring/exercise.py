"""Exercises: what a learner shall do with the probe, read from YAML, and whether a scan did it.

>>> from us_sim.scoring.exercise import read_exercise
>>> exercise = read_exercise("compression")
>>> exercise.task.name, exercise.assigned.structure
('compression', 'vein')
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import ScoreError
from us_sim.geometry.pose import Placement, Pose
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
_PRESSED = 0.9  # part of a vein's area below which it was pressed, and not only passed
_MM = 1e3


class Step(NamedTuple):
    """One thing to do, and what was seen of it."""

    what: str
    is_done: bool
    seen: str
    # (P, 3) m in frame ``patient``, where it is to be done: one point, or those of a line
    target: NDArray[np.float64] | None = None
    pose: Pose | None = None  # of the probe, that is to be found
    is_missed: bool = False  # whether it was tried in vain, and the probe has moved on


class Attempt(ABC):
    """An attempt at a task: a scan is added to it whole, or in pieces one after another."""

    @abstractmethod
    def add(self, scan: Scan) -> None:
        """Take the samples that are new."""

    @abstractmethod
    def steps(self) -> list[Step]:
        """Every thing that is to be done."""


class Task(Settings):
    """Base of what an exercise may ask for."""

    error: ClassVar = ScoreError
    section: ClassVar = "task"

    @property
    def structures(self) -> tuple[str, ...]:
        """Names of the vessels that the scene must have."""
        return ()

    @abstractmethod
    def begin(self, lines: Mapping[str, CentreLine]) -> Attempt:
        """An attempt at it, in a scene with these vessels."""


class _Hold:
    """The longest time (s) for which something was held without a break."""

    def __init__(self) -> None:
        self.longest = self._held = 0.0
        self._last, self._was = 0.0, False

    def add(self, times: NDArray[np.float64], within: NDArray[np.bool_]) -> None:
        for time, now in zip(times.tolist(), within.tolist(), strict=True):
            self._held = self._held + time - self._last if now and self._was else 0.0
            self.longest = max(self.longest, self._held)
            self._last, self._was = time, now


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

    def begin(self, lines: Mapping[str, CentreLine]) -> Attempt:
        """An attempt with a step for each point."""
        line = lines[self.structure]
        points = self.points(float(line.lengths[-1])).tolist()
        return _Points([_Point(self, at, line.at(at)) for at in points])


class _Points(Attempt):
    def __init__(self, points: list[_Point]) -> None:
        self._points = points

    def add(self, scan: Scan) -> None:
        for point in self._points:
            point.add(scan)

    def steps(self) -> list[Step]:
        return [point.step() for point in self._points]


class _Point:
    """A point of a vein, and all that was seen around it.

    Args:
        task: with the limits.
        at: m along the vein.
        place: (3,) m, the same in frame ``patient``.
    """

    def __init__(self, task: Compression, at: float, place: NDArray[np.float64]) -> None:
        self._task, self._at, self._place = task, at, place
        self._closed: tuple[float, float] | None = None  # N, and the part of the artery left open
        self._least, self._force = np.inf, np.nan  # part that was open at least, and N then
        self._most = 0.0  # N, of all images
        self._is_thrombus = self._is_here = False

    def add(self, scan: Scan) -> None:
        task = self._task
        begin, end = scan.thrombi.get(task.structure, (np.inf, -np.inf))
        self._is_thrombus = begin - task.tolerance <= self._at <= end + task.tolerance
        section = scan.sections.get(task.structure)
        if section is None:
            return
        new = section.times > scan.since
        is_near = np.abs(section.along - self._at) <= task.tolerance
        self._is_here = bool(is_near[new][-1]) if new.any() else self._is_here
        near = np.flatnonzero(new & is_near & np.isfinite(section.fraction))
        if not len(near):
            return
        left = section.fraction[near]
        force = scan.force.at(section.times[near]) if scan.force else np.full(len(near), np.nan)
        least = int(np.argmin(left))
        if left[least] < self._least:
            self._least, self._force = float(left[least]), float(force[least])
        self._most = max(self._most, float(np.nan_to_num(force).max()))
        artery = scan.sections.get(task.artery or "")
        for k in np.flatnonzero(left <= task.closed).tolist():
            part = float(artery.fraction[near[k]]) if artery is not None else 1.0
            part = part if np.isfinite(part) else 1.0  # nobody knows
            if self._closed is None or (self._closed[1] < task.open <= part):
                self._closed = float(force[k]), part

    def step(self) -> Step:
        task = self._task
        is_done, seen = self._seen()
        is_missed = not is_done and not self._is_here and self._least < _PRESSED
        what = f"{task.structure} at {_MM * self._at:.0f} mm"
        return Step(what, is_done, seen, self._place[None], is_missed=is_missed)

    def _seen(self) -> tuple[bool, str]:
        task = self._task
        if self._closed is not None:
            force, artery = self._closed
            is_open = artery >= task.open
            also = "" if is_open else f", and of the {task.artery} {100 * artery:.0f} % were left"
            return is_open, f"closed{_newtons(force)}{also}"
        if self._least == np.inf:
            return False, "not reached"
        seen = f"{100 * self._least:.0f} % open{_newtons(self._force)}"
        if self._most < task.enough:
            return False, f"{seen}: press harder"
        return self._is_thrombus, f"{seen}: {'a thrombus' if self._is_thrombus else 'not closed'}"


@dataclass(frozen=True)
class KeepForce(Task):
    """Press with one force and keep it."""

    force: float = setting(Quantity(_FORCE, 0.01, 200.0), "to press with", default=5.0)
    tolerance: float = setting(Quantity(_FORCE, 0.01, 200.0), "above and below", default=1.0)
    duration: float = setting(_TIME, "without leaving it", default=5.0)

    def begin(self, lines: Mapping[str, CentreLine]) -> Attempt:  # noqa: ARG002
        """An attempt with one step."""
        return _KeptForce(self)


class _KeptForce(Attempt):
    def __init__(self, task: KeepForce) -> None:
        self._task, self._hold, self._is_known = task, _Hold(), False

    def add(self, scan: Scan) -> None:
        if scan.force is not None:
            self._is_known = True
            new = scan.force.times > scan.since
            within = np.abs(scan.force.newtons - self._task.force) <= self._task.tolerance
            self._hold.add(scan.force.times[new], within[new])

    def steps(self) -> list[Step]:
        task = self._task
        what = f"{task.force:g} ± {task.tolerance:g} N for {task.duration:g} s"
        if not self._is_known:
            return [Step(what, False, "the recording has no force")]
        return [_held(what, self._hold, task.duration)]


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

    def begin(self, lines: Mapping[str, CentreLine]) -> Attempt:
        """An attempt with one step."""
        return _Centred(self, lines[self.structure])


class _Centred(Attempt):
    def __init__(self, task: Centre, line: CentreLine) -> None:
        self._task, self._line, self._hold, self._is_seen = task, line, _Hold(), False

    def add(self, scan: Scan) -> None:
        section = scan.sections.get(self._task.structure)
        if section is not None:
            new = section.times > scan.since
            self._is_seen |= bool(np.isfinite(section.fraction[new]).any())
            within = _is_centred(section, self._task.offset)
            self._hold.add(section.times[new], within[new])

    def steps(self) -> list[Step]:
        task, points = self._task, self._line.points
        what = f"{task.structure} within {_MM * task.offset:g} mm for {task.duration:g} s"
        if not self._is_seen:
            return [Step(what, False, "never in the image", points)]
        return [_held(what, self._hold, task.duration)._replace(target=points)]


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

    def begin(self, lines: Mapping[str, CentreLine]) -> Attempt:
        """An attempt with one step."""
        return _Followed(self, lines[self.structure])


class _Followed(Attempt):
    """Pieces of 2 mm that were passed between two images, or seen in one."""

    def __init__(self, task: Follow, line: CentreLine) -> None:
        self._task, self._line = task, line
        self._pieces = np.arange(task.margin, line.lengths[-1] - task.margin, 0.002)
        self._seen = np.zeros(len(self._pieces), bool)
        self._last: float | None = None  # m along the vessel, where it was centred just before

    def add(self, scan: Scan) -> None:
        section = scan.sections.get(self._task.structure)
        if section is None:
            return
        new = section.times > scan.since
        centred = _is_centred(section, self._task.offset)[new]
        for along, now in zip(section.along[new].tolist(), centred.tolist(), strict=True):
            if now:
                last = self._last if self._last is not None else along
                low, high = sorted((last, along))
                self._seen |= (self._pieces > low - 0.002) & (self._pieces < high + 0.002)
            self._last = along if now else None

    def steps(self) -> list[Step]:
        part = float(self._seen.mean()) if len(self._seen) else 0.0
        what = f"{100 * self._task.part:.0f} % of the {self._task.structure} in the image's middle"
        return [Step(what, part >= self._task.part, f"{100 * part:.0f} % seen", self._line.points)]


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

    def begin(self, lines: Mapping[str, CentreLine]) -> Attempt:  # noqa: ARG002
        """An attempt with one step."""
        return _Found(self)


class _Found(Attempt):
    def __init__(self, task: View) -> None:
        self._task, self._hold = task, _Hold()
        self._nearest = np.inf, np.inf, np.inf  # how far in all, m, rad

    def add(self, scan: Scan) -> None:
        task, wanted = self._task, self._task.pose.pose
        new = scan.motion.times > scan.since
        times = scan.motion.times[new]
        if not len(times):
            return
        apart = np.linalg.norm(scan.motion.positions[new] - wanted.position, axis=1)
        shared = np.abs(scan.motion.orientations[new] @ wanted.orientation)
        turned = 2.0 * np.arccos(np.minimum(shared, 1.0))
        within = (apart <= task.distance) & (turned <= task.angle)
        for name in task.visible:
            section = scan.sections.get(name)
            if section is None:
                within[:] = False
                continue
            last = np.searchsorted(section.times, times, side="right") - 1  # image
            within &= (last >= 0) & (section.area[last] > 0)
        self._hold.add(times, within)
        best = int(np.argmin(apart / task.distance + turned / task.angle))
        far = apart[best] / task.distance + turned[best] / task.angle
        self._nearest = min(self._nearest, (far, apart[best], turned[best]))

    def steps(self) -> list[Step]:
        task = self._task
        what = f"the view within {_MM * task.distance:g} mm and {np.rad2deg(task.angle):.0f}°"
        held = _held(f"{what} for {task.duration:g} s", self._hold, task.duration)
        _, apart, turned = self._nearest
        if np.isfinite(apart):
            near = f"nearest {_MM * apart:.1f} mm and {np.rad2deg(turned):.0f}°"
            held = held._replace(seen=f"{held.seen}; {near}")
        return [held._replace(pose=task.pose.pose)]


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

    def begin(self, lines: Mapping[str, CentreLine]) -> Attempt:
        """An attempt at it, in a scene with these vessels.

        Raises:
            ScoreError: some that the task needs are missing; one sentence with the structure.
        """
        for name in self.assigned.structures:
            if name not in lines:
                known = unknown(name, lines) if lines else f"{name!r} is not known"
                of = "the vessels of the scene" if lines else "a scan without a scene"
                raise ScoreError(f"exercise {self.name}: in {of} the structure {known}")
        attempt: Attempt = self.assigned.begin(lines)
        return attempt

    def steps(self, scan: Scan) -> list[Step]:
        """Steps to be done, with what was seen of each in a whole scan.

        Raises:
            ScoreError: as `begin`.
        """
        attempt = self.begin(scan.lines)
        attempt.add(scan)
        return attempt.steps()


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


def result_of(done: Sequence[bool]) -> str:
    """The result of steps in words.

    >>> result_of([True, False])
    'not passed: 1 of 2 done'
    """
    return f"{'passed' if all(done) else 'not passed'}: {sum(done)} of {len(done)} done"


def _newtons(force: float) -> str:
    return f" at {force:.1f} N" if np.isfinite(force) else ""


def _is_centred(section: Section, offset: float) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        return np.asarray(np.abs(section.lateral) <= offset)


def _held(what: str, hold: _Hold, duration: float) -> Step:
    return Step(what, hold.longest >= duration, f"held for {hold.longest:.1f} s")
