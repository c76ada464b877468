"""Exercises for a learner with the probe, read from YAML, and attempts at them."""

from __future__ import annotations

import hashlib
import os
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import ScoreError
from us_sim.scoring.centre_line import CentreLine
from us_sim.scoring.metrics import Force, Scan
from us_sim.scoring.settings import CONTACT_FORCE
from us_sim.settings.choice import ChosenOption
from us_sim.settings.quantity import Quantity
from us_sim.settings.reading import SettingsReader
from us_sim.settings.registry import EXERCISES
from us_sim.settings.setting import Settings, setting
from us_sim.settings.spelling import describe_unknown
from us_sim.settings.text_files import read_yaml
from us_sim.share import shared_roots

_Array = NDArray[np.float64]
_TIME, _FORCE = Quantity("time", 0.1, 3600.0), Quantity("force", 0.01, 200.0)
_MM = 1e3
_MOVED = 1e-3  # m, by which a hand has moved the probe
LIGHT_FORCE = 3.0  # N, below which a probe lies on the skin and does not press
SILENT = 1.0  # s without a sample, in which nobody knows whether something was held


class Step(NamedTuple):
    """One thing to do, and what was seen of it."""

    what: str
    is_done: bool
    seen: str
    # (P, 3) m in frame ``patient``, the place of it: one point, or those of a line
    target: _Array | None = None
    is_missed: bool = False  # it was tried in vain, and the probe has moved on

    def to_document(self) -> dict[str, Any]:
        """Return it as JSON, with its ``state``: done, missed, or to do."""
        state = "done" if self.is_done else "missed" if self.is_missed else "to do"
        target = {} if self.target is None else {"target": self.target.round(4).tolist()}
        return {"what": self.what, "state": state, "seen": self.seen, **target}


class Fault(NamedTuple):
    """Something that was done wrong."""

    time: float  # s since the first pose
    what: str


class Attempt(ABC):
    """An attempt at a task: a scan is added to it whole, or in pieces one after another.

    It begins when a hand moves the probe in the air for the first time: a scene may be loaded, or
    an attempt begun anew, under a probe that presses already. A scan without force begins at once,
    since nobody knows when it touches.
    """

    is_blind = False  # steps say only what an image shows, until the attempt has ended
    touched: float | None = None  # s since the first pose, of the first touch of the skin
    ended: float | None = None  # s, when all was done or the time was over; None before
    faults: Sequence[Fault] = ()  # everything that was done wrong, in order
    _has_begun = False
    _is_felt = False  # there was a force
    # s and (3,) m: since when, and from where, the probe is in the air
    _air: tuple[float, _Array] | None = None
    _time = 0.0  # s, of the last pose
    _pressed = 0.0  # N, the most before the begin

    @property
    def was_in_air(self) -> bool:
        """True once the attempt has begun, or begins with the next motion of the probe."""
        return self._has_begun or self._air is not None

    def add_scan(self, scan: Scan) -> Scan | None:
        """Add the samples that are new; return those that count, None before the begin."""
        self._is_felt |= scan.force is not None
        times, is_touching = scan.motion.times, np.full(len(scan.motion), not self._is_felt)
        if scan.force is not None:
            times, is_touching = scan.force.times, scan.force.newtons >= CONTACT_FORCE
            if not self._has_begun:
                begin = self._find_begin(scan, scan.force)
                if begin is None:
                    return None
                if self._pressed >= LIGHT_FORCE:
                    self.faults = [Fault(begin, f"{self._pressed:.1f} N before the begin")]
                scan = replace(scan, since=max(scan.since, float(np.nextafter(begin, -np.inf))))
        self._has_begun, self._time = True, float(scan.motion.times[-1])
        if self.touched is None:
            touching = times[(times > scan.since) & is_touching]
            self.touched = float(touching[0]) if len(touching) else None
        self.add_samples(scan)
        return scan

    def _find_begin(self, scan: Scan, force: Force) -> float | None:
        """Return since when the probe was in the air from where a hand has moved it.

        A force that comes without a motion is a simulation that has just started, and no touch.
        """
        new = force.times > scan.since
        times, newtons = force.times[new], force.newtons[new].tolist()
        places = scan.motion.interpolate_positions(times)
        for time, place, newton in zip(times.tolist(), places, newtons, strict=True):
            if self._air is not None and np.linalg.norm(place - self._air[1]) >= _MOVED:
                return self._air[0]
            self._pressed = max(self._pressed, newton)
            if newton >= CONTACT_FORCE:
                self._air = None
            elif self._air is None:
                self._air = time, place
        return None

    def find_force(self, scan: Scan, times: _Array) -> _Array:
        """Return the force (N) at times (s); NaN where it is not known."""
        unknown = np.full(len(times), np.nan)
        return unknown if scan.force is None else scan.force.interpolate_at(times)

    @abstractmethod
    def add_samples(self, scan: Scan) -> None:
        """Add the samples that are new and count."""

    @abstractmethod
    def list_steps(self) -> list[Step]:
        """Return the steps of the task, with what was seen of each."""

    def set_answers(self, points: Sequence[str], thrombus: str, time: float) -> None:  # noqa: ARG002
        """Set the learner's answers so far; the last one ends the attempt.

        Args:
            points: one for each point, of `ANSWERS`, or `NO_ANSWER`.
            thrombus: number of a point at it, "none", or "" for no answer yet.
            time: s since the first pose, of the answers.

        Raises:
            ScoreError: nothing is asked, the attempt has ended, or an answer will not do.
        """
        raise ScoreError("answers: this exercise asks nothing")

    def compute_duration(self) -> float | None:
        """Return the s from the first touch to the end, or so far; None before the first."""
        end = self._time if self.ended is None else self.ended
        return None if self.touched is None else end - self.touched


class Task(Settings):
    """Base of the tasks that an exercise may set."""

    error: ClassVar = ScoreError
    section: ClassVar = "task"
    asks: ClassVar[bool] = False  # it has questions that a learner can answer, if nothing is told

    @property
    def structures(self) -> tuple[str, ...]:
        """Names of the vessels that the scene must have."""
        return tuple(filter(None, (vars(self).get(key) for key in ("structure", "artery"))))

    @abstractmethod
    def begin_attempt(self, lines: Mapping[str, CentreLine]) -> Attempt:
        """Return an attempt at it, in a scene with these vessels."""


@dataclass(frozen=True)
class KeepForce(Task):
    """Press with one force and keep it."""

    force: float = setting(_FORCE, "to press with", default=5.0)
    tolerance: float = setting(_FORCE, "above and below", default=1.0)
    duration: float = setting(_TIME, "without leaving it", default=5.0)

    def begin_attempt(self, lines: Mapping[str, CentreLine]) -> Attempt:  # noqa: ARG002
        """Return an attempt with one step."""
        return _KeptForce(self)


@dataclass(frozen=True)
class Centre(Task):
    """Bring a vessel to the middle of the image and hold it there."""

    structure: str = setting(description="vessel to be centred", default="vein")
    offset: float = setting(
        Quantity("length", 1e-4, 1.0), "from the image's middle at most", default=0.003
    )
    duration: float = setting(_TIME, "without losing it", default=3.0)
    force_limit: float = setting(_FORCE, "above which it is not held", default=20.0)

    def begin_attempt(self, lines: Mapping[str, CentreLine]) -> Attempt:
        """Return an attempt with one step."""
        return _Centred(self, lines[self.structure])


class _Holding(Attempt):
    """An attempt to hold something without a break, which ends when it was held long enough."""

    _longest = _held = 0.0  # s
    _last, _was = 0.0, False  # s, of the last sample, and whether it was held at it

    def _hold(self, times: _Array, within: NDArray[np.bool_], duration: float) -> None:
        """Add samples: their times (K,) s, and whether it was held at each."""
        for time, now in zip(times.tolist(), within.tolist(), strict=True):
            since = time - self._last
            self._held = self._held + since if now and self._was and since <= SILENT else 0.0
            self._longest = max(self._longest, self._held)
            if self.ended is None and self._longest >= duration:
                self.ended = time
            self._last, self._was = time, now

    def _step(self, what: str, now: str = "", target: _Array | None = None) -> Step:
        """Return the step, with how it is now, and how long it is held now and was at most."""
        is_done, seen = self.ended is not None, f"held for {self._longest:.1f} s"
        if not is_done and self._held < self._longest:
            seen = f"held for {self._held:.1f} s, {self._longest:.1f} s at most"
        return Step(what, is_done, seen if is_done else now + seen, target)


class _KeptForce(_Holding):
    _newtons: float | None = None  # the last

    def __init__(self, task: KeepForce) -> None:
        self._task = task

    def add_samples(self, scan: Scan) -> None:
        task, force = self._task, scan.force
        if force is not None:
            new = force.times > scan.since
            within = np.abs(force.newtons - task.force) <= task.tolerance
            self._hold(force.times[new], within[new], task.duration)
            self._newtons = float(force.newtons[-1])

    def list_steps(self) -> list[Step]:
        task = self._task
        what = f"{task.force:g} ± {task.tolerance:g} N for {task.duration:g} s"
        if self._newtons is None:
            return [Step(what, False, "no force yet")]
        return [self._step(what, f"{self._newtons:.1f} N now; ")]


class _Centred(_Holding):
    _is_seen = False
    _newtons = 0.0  # the last

    def __init__(self, task: Centre, line: CentreLine) -> None:
        self._task, self._line = task, line

    def add_samples(self, scan: Scan) -> None:
        task, section = self._task, scan.sections.get(self._task.structure)
        if section is not None:
            new = section.times > scan.since
            self._is_seen |= bool(np.isfinite(section.fraction[new]).any())
            within = np.abs(section.lateral[new]) <= task.offset
            if self._is_felt:
                newtons = self.find_force(scan, section.times[new])
                within &= (newtons >= CONTACT_FORCE) & (newtons <= task.force_limit)
                self._newtons = [self._newtons, *newtons.tolist()][-1]
            self._hold(section.times[new], within, task.duration)

    def list_steps(self) -> list[Step]:
        task, points = self._task, self._line.points
        what = f"{task.structure} within {_MM * task.offset:g} mm for {task.duration:g} s"
        if not self._is_seen:
            return [Step(what, False, "never in the image", points)]
        now = f"{self._newtons:.1f} N: press less; " if self._newtons > task.force_limit else ""
        return [self._step(what, now, points)]


@dataclass(frozen=True)
class Exercise(Settings):
    """An exercise: a task in words, and its settings.

    Examples:
        >>> exercise = read_exercise("compression")
        >>> exercise.task.name, exercise.assigned.structure
        ('compression', 'vein')
    """

    error: ClassVar = ScoreError

    name: str = setting(description="of the exercise")
    task: ChosenOption = setting(choice=EXERCISES)
    description: str = setting(description="of what is to be done, for the learner", default="")
    scene: str | None = setting(description="scene that it is made for", default=None)
    lesson: int | None = setting(
        Quantity("number", 1, 100), "number of it in a lesson of several", default=None
    )
    minutes: int = setting(Quantity("number", 1, 240), "that it takes about", default=5)
    feedback: str = setting(
        description="live: what is right is said at once; afterwards: the page shows what a "
        "scanner shows, the learner answers, and the result compares with the truth",
        choices=("live", "afterwards"),
        default="live",
    )
    seeds: tuple[int, int] | None = setting(
        Quantity("number", 0, 2**31),
        "lowest and highest seed of the scene's phantom, one of which is drawn each time",
        default=None,
    )
    origin: str = ""  # its file
    checksum: str = ""  # of that file: the first 12 digits of its SHA-256

    def check(self) -> None:
        """Refuse feedback afterwards for a task without a question."""
        if self.feedback == "afterwards" and not self.assigned.asks:
            raise self.make_error("feedback", "afterwards is for a compression, which asks")

    @property
    def assigned(self) -> Any:
        """The task with its settings."""
        return self.task.resolve_settings(EXERCISES)

    def begin_attempt(self, lines: Mapping[str, CentreLine]) -> Attempt:
        """Return an attempt at it, in a scene with these vessels.

        Raises:
            ScoreError: one that the task needs is missing.
        """
        for name in self.assigned.structures:
            if name not in lines:
                known = describe_unknown(name, lines) if lines else f"{name!r} is not known"
                of = "the vessels of the scene" if lines else "a scan without a scene"
                raise ScoreError(f"exercise {self.name}: in {of} the structure {known}")
        attempt: Attempt = self.assigned.begin_attempt(lines)
        attempt.is_blind = self.feedback == "afterwards"
        return attempt


def read_exercise(name: str | Path) -> Exercise:
    """Read an exercise: a file, or the name of one in ``config/exercises``.

    Raises:
        ScoreError: it is not there, or a value in it cannot be used.
    """
    path = Path(os.path.expanduser(name))
    if not path.is_file():
        known = find_exercise_files()
        if str(name) not in known:
            raise ScoreError(f"exercise {describe_unknown(str(name), sorted(known))}")
        path = known[str(name)]
    reader = SettingsReader(str(path), None, ScoreError)
    exercise = reader.read(Exercise, read_yaml(path, ScoreError))
    checksum = hashlib.sha256(path.read_bytes()).hexdigest()[:12]
    return replace(exercise, origin=str(path.resolve()), checksum=checksum)


def read_installed_exercises() -> list[Exercise]:
    """Read those in ``config/exercises``: the lesson in its order, then the others by name."""
    found = [read_exercise(file) for file in find_exercise_files().values()]
    return sorted(found, key=lambda each: (each.lesson or len(found) + 1, each.name))


def find_exercise_files() -> dict[str, Path]:
    """Return the files in ``config/exercises`` by the names of their exercises."""
    return {
        f.stem: f for root in shared_roots() for f in (root / "config/exercises").glob("*.yaml")
    }
