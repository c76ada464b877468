"""Compression of a vein point by point, as in an examination for thrombosis.

A point counts when the vein was seen open there, was closed there by a press that kept its place,
and was let go. A thrombus keeps a vein from closing: there it is enough to have pressed hard.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import ScoreError
from us_sim.geometry.pose import Pose
from us_sim.scoring.centre_line import CentreLine
from us_sim.scoring.exercise import LIGHT_FORCE, SILENT, Attempt, Fault, Step, Task
from us_sim.scoring.metrics import Scan
from us_sim.scoring.settings import ANSWERS, CONTACT_FORCE, NO_ANSWER, NO_THROMBUS
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import setting
from us_sim.slicing.settings import WALLS_TOUCH

_SPACING = 0.02  # m, between points along the vein
_MARGIN = 0.008  # m, left out at both ends of the vein
_TOLERANCE = 0.005  # m, from a point, within which it counts, and within which a press stays
_OPEN = 0.5  # part of its area at rest from which a vessel counts as open
_ENOUGH = 10.0  # N, after which a vein that is still open holds a thrombus
_LOOKED = 0.3  # s, for which a person must see a vein open, or closed, to be sure of it
_TURN = np.deg2rad(20.0)  # by which a press may turn
_EDGE = 3e-3  # m from a thrombus' end, within which both answers are right
_MM = 1e3


@dataclass(frozen=True)
class Compression(Task):
    """Compress a vein point by point.

    Points every 2 cm are those of Needleman et al., "Ultrasound for lower extremity deep venous
    thrombosis", Circulation 137 (2018).
    """

    asks = True

    structure: str = setting(description="vein to be compressed", default="vein")
    artery: str | None = setting(description="artery that must stay open", default=None)
    points: tuple[float, ...] | int | None = setting(
        Quantity("length", 0.0, 100.0),
        "number of points, or their places along the vein; not given: as many as there is room for",
        default=None,
    )
    force_limit: float = setting(
        Quantity("force", 0.1, 200.0), "above which a press does not count", default=20.0
    )
    lift_between: bool = setting(
        description="whether the probe must leave the skin between two presses; else it is enough "
        "that the vein is open again",
        default=False,
    )
    time_limit: float | None = setting(
        Quantity("time", 1.0, 36000.0), "from the first touch to the last point", default=None
    )

    def check(self) -> None:
        """Refuse a task without a point."""
        if self.points in ((), 0):
            raise self.make_error("points", "is empty: name at least one")

    def place_points(self, length: float) -> NDArray[np.float64]:
        """Return the points (N,), m along a vein of that length (m).

        Raises:
            ScoreError: a place that was given is not on the vein.
        """
        if isinstance(self.points, tuple):
            if max(self.points) > length:
                raise ScoreError(
                    f"task.points: {_MM * max(self.points):.0f} mm is not on the {self.structure}, "
                    f"which is {_MM * length:.0f} mm long"
                )
            return np.array(self.points)
        room = max(length - 2 * _MARGIN, 0.0)
        count = self.points or int(room / _SPACING + 1e-9) + 1
        spacing = _SPACING if self.points is None else room / max(count - 1, 1)
        steps = np.arange(count) - 0.5 * (count - 1)
        return np.asarray(0.5 * length + spacing * steps, np.float64)

    def begin_attempt(self, lines: Mapping[str, CentreLine]) -> Attempt:
        """Return an attempt with a step for each point, and one for the time if it is limited."""
        line = lines[self.structure]
        places = self.place_points(float(line.lengths[-1])).tolist()
        return _Examination(self, [_Point(at, line.interpolate_point(at)) for at in places])


class _Look(NamedTuple):
    """One image in which the vein was measured."""

    time: float  # s
    along: float  # m, of the place on the vein; NaN where the image does not cut it
    part: float  # of its area at rest; NaN where nobody knows
    force: float  # N; NaN without force
    peak: float  # N, the most since the image before
    artery: float  # part of the artery's area at rest; 1 where nobody knows
    pose: Pose  # of the probe

    @property
    def is_touching(self) -> bool:
        return not self.force < CONTACT_FORCE

    @property
    def is_pressing(self) -> bool:
        """The vein is pressed, by its area or by the force."""
        return self.is_touching and (self.part < _OPEN or self.force >= LIGHT_FORCE)


@dataclass
class _Point:
    """A point of the vein, and the state of its examination."""

    at: float  # m along the vein
    place: NDArray[np.float64]  # (3,) m, the same in frame ``patient``
    is_done: bool = False
    seen: str = "not reached"
    is_examined: bool = False  # by a press that counts
    most: float | None = None  # N, of the last press; None where there was none
    answer: str = ""  # of `ANSWERS`


@dataclass
class _Press:
    """A press, until the probe lies on the skin lightly again, with the vein open."""

    begin: _Look
    problem: str = ""  # why it does not count
    has_slid: bool = False
    least: float = np.inf  # part that was open at least
    force: float = np.nan  # N then
    most: float = 0.0  # N
    closed: tuple[float, float] | None = None  # N, and the part of the artery that was open
    closed_since: float = np.inf  # s
    hard_since: float = np.inf  # s, with the force that shows a thrombus
    is_hard: bool = False  # for long enough to see that the vein stays open

    def add_look(self, look: _Look) -> None:
        """Add an image of it."""
        self.most = max(self.most, float(np.nan_to_num(look.peak)))
        if look.part < self.least:
            self.least, self.force = look.part, look.force
        is_closed = look.part <= WALLS_TOUCH
        self.closed_since = min(self.closed_since, look.time) if is_closed else np.inf
        self.hard_since = min(self.hard_since, look.time) if look.force >= _ENOUGH else np.inf
        self.is_hard |= look.time - self.hard_since >= _LOOKED
        is_better = self.closed is None or self.closed[1] < _OPEN <= look.artery
        if look.time - self.closed_since >= _LOOKED and is_better:
            self.closed = look.force, look.artery

    def describe(self) -> str:
        """Return words for what was seen of the vein."""
        if self.closed is not None:
            return f"closed{_format_force(self.closed[0])}"
        return f"{100 * self.least:.0f} % open{_format_force(self.force)}"


class _Examination(Attempt):
    """All presses of an attempt, in the order of its images."""

    def __init__(self, task: Compression, points: list[_Point]) -> None:
        self._task, self._points = task, points
        self._press: _Press | None = None
        self._open: tuple[float, float] | None = None  # s since when, and m where it is seen open
        self._was_lifted = True  # since the last press
        self._along = np.nan  # m, of the last image
        self._looked = -np.inf  # s, of the last image
        self._is_over = False  # whether the force is over its limit
        self._thrombus = np.inf, -np.inf  # m, from and to
        self.faults: list[Fault] = []
        self._answer = ""  # where the thrombus is: a point's number, or that there is none

    def set_answers(self, points: Sequence[str], thrombus: str, time: float) -> None:
        """Set the learner's answers, see `Attempt.set_answers`."""
        numbers = [str(k + 1) for k in range(len(self._points))]
        if not self.is_blind:
            super().set_answers(points, thrombus, time)
        if self.ended is not None or self.touched is None:
            raise ScoreError("answers: taken from the first touch until the attempt has ended")
        if len(points) > len(numbers) or not {*points} <= {*ANSWERS, NO_ANSWER}:
            raise ScoreError(f"answers: {', '.join(ANSWERS)} or - for {len(numbers)} points")
        if thrombus not in ("", NO_THROMBUS, *numbers):
            raise ScoreError(f"thrombus: {NO_THROMBUS}, or a point's number, 1 to {len(numbers)}")
        for point, answer in zip(self._points, points, strict=False):
            point.answer = "" if answer == NO_ANSWER else answer
        self._answer = thrombus
        if thrombus and all(point.answer for point in self._points):
            self.ended = time

    def add_samples(self, scan: Scan) -> None:
        """Add the images that are new."""
        task, force = self._task, scan.force
        self._thrombus = scan.thrombi.get(task.structure, self._thrombus)
        vein, artery = (scan.sections.get(name or "") for name in (task.structure, task.artery))
        if vein is None:
            return
        newtons = self.find_force(scan, vein.times)
        beside = np.ones(len(newtons)) if artery is None else np.nan_to_num(artery.fraction, nan=1)
        rows = np.stack([vein.times, vein.along, vein.fraction, newtons, beside], axis=1)
        poses = scan.motion.sample_poses(vein.times)
        is_counted = np.isfinite(newtons) | (not self._is_felt)
        for k in np.flatnonzero((vein.times > scan.since) & is_counted):
            time, along, part, newton, left = rows[k].tolist()
            if self.ended is not None and time > self.ended:
                return
            peak = newton
            if force is not None:
                between = force.newtons[(force.times > self._looked) & (force.times <= time)]
                peak = float(between.max(initial=np.nan_to_num(newton)))
            self._look(_Look(time, along, part, newton, peak, left, poses[k]))
            self._looked = time

    def list_steps(self) -> list[Step]:
        """Return one step for each point, and one for the time if it is limited."""
        pressed = self._find_pressed()
        make_step = self._hidden_step if self.is_blind else self._step
        steps = [make_step(k, each, each is pressed) for k, each in enumerate(self._points, 1)]
        if self.is_blind:
            steps.append(self._thrombus_step())
        limit, seconds = self._task.time_limit, self.compute_duration() or 0.0
        if limit is not None:
            steps.append(
                self._conclude(f"within {limit:g} s", seconds <= limit, f"{seconds:.0f} s")
            )
        return steps

    def _conclude(
        self, what: str, is_right: bool, seen: str, target: NDArray[np.float64] | None = None
    ) -> Step:
        """Return a step that is neither done nor missed before the attempt has ended."""
        has_ended = self.ended is not None
        return Step(what, has_ended and is_right, seen, target, has_ended and not is_right)

    def _step(self, number: int, point: _Point, is_pressed: bool) -> Step:
        """Return the step of a point: what goes on there, or was seen."""
        press, is_here, seen = self._press, abs(self._along - point.at) <= _TOLERANCE, point.seen
        if press is not None and not point.is_done:
            is_shown = press.closed is not None or (press.is_hard and self._has_thrombus(point))
            advice = "let go" if is_shown else "press harder"
            if is_pressed or (is_here and press.problem):
                seen = press.problem or f"{press.describe()}: {advice}"
        elif not point.is_done and is_here and self._is_seen_open(self._along):
            seen = "seen open: press"
        is_missed = point.most is not None and not (point.is_done or is_here)
        what = f"{number}: {self._task.structure} at {_MM * point.at:.0f} mm"
        return Step(what, point.is_done, seen, point.place[None], is_missed)

    def _hidden_step(self, number: int, point: _Point, is_pressed: bool) -> Step:
        """Return the step of a point on which the learner answers."""
        most = self._press.most if self._press is not None and is_pressed else point.most
        pressed = "not pressed" if most is None else f"pressed with {most:.1f} N"
        seen = f"{pressed}, {point.answer or 'no answer yet'}"
        truths = self._truths(point)
        is_right = point.answer in truths
        if self.ended is not None and not is_right:
            seen = f"{seen}: it is {' or '.join(truths)}"
        elif self.ended is not None and not point.is_examined:
            seen = f"{seen}: right, and not examined: {point.seen}"
        is_done = is_right and point.is_examined
        return self._conclude(f"point {number}", is_done, seen, point.place[None])

    def _thrombus_step(self) -> Step:
        seen = f"at point {self._answer}" if self._answer.isdigit() else self._answer
        truths = enumerate(map(self._truths, self._points), 1)
        where = [str(number) for number, each in truths if ANSWERS[1] in each]
        is_right = self._answer in (where or [NO_THROMBUS])
        if self.ended is None:
            seen = seen or "no answer yet"
        elif not is_right:
            seen = f"{seen}: {f'it is at point {where[0]}' if where else 'there is none'}"
        return self._conclude("thrombus", is_right, seen)

    def _truths(self, point: _Point) -> tuple[str, ...]:
        """Return the right answers on a point; both are right within 3 mm of a thrombus' end."""
        (begin, end), (compressible, not_compressible, _) = self._thrombus, ANSWERS
        inside = min(point.at - begin, end - point.at)
        if abs(inside) <= _EDGE:
            return not_compressible, compressible
        return (not_compressible,) if inside > 0 else (compressible,)

    def _look(self, look: _Look) -> None:
        task = self._task
        begun = look.time if self.touched is None else self.touched
        if task.time_limit is not None and look.time - begun > task.time_limit:
            self.ended = look.time
            return
        if look.time - self._looked > SILENT:  # nobody knows what was between
            self._open = None
            if self._press is not None:
                self._press.closed_since = self._press.hard_since = np.inf
        self._along = look.along if np.isfinite(look.along) else self._along
        if self._press is None and look.is_pressing:
            self._press = _Press(look, self._explain_early(look))
        if self._press is not None:
            self._press.add_look(look)
            self._check_place(look, self._press)
        self._check_force(look)
        self._was_lifted |= not look.is_touching
        if self._press is not None and not look.is_pressing:
            self._finish(self._press)
        self._see_open(look)
        if not self.is_blind and all(point.is_done for point in self._points):
            self.ended = look.time

    def _see_open(self, look: _Look) -> None:
        """Note the time since when, and the place where, the vein is seen open."""
        if not look.is_touching or look.is_pressing:
            self._open = None
            return
        is_elsewhere = self._open and abs(look.along - self._open[1]) > _TOLERANCE
        if look.part >= _OPEN and (self._open is None or is_elsewhere):
            self._open = look.time, look.along

    def _explain_early(self, look: _Look) -> str:
        """Return why a press that begins does not count; "" if it does so far."""
        if self._task.lift_between and not self._was_lifted:
            return "pressed again without a lift: lift the probe between two presses"
        if self._is_seen_open(look.along):
            return ""
        return "pressed before the vein was seen open there: touch lightly first"

    def _is_seen_open(self, along: float) -> bool:
        """Return whether the vein has been seen open there for long enough."""
        since, where = self._open or (np.inf, np.nan)
        return abs(along - where) <= _TOLERANCE and self._looked - since >= _LOOKED

    def _check_place(self, look: _Look, press: _Press) -> None:
        """Void a press that slides over the skin or turns."""
        moved = press.begin.pose.inverse() @ look.pose
        slid = float(np.hypot(*moved.position[:2]))
        turned = 2.0 * np.arccos(min(abs(moved.orientation[3]), 1.0))
        if press.has_slid or not look.is_touching or (slid <= _TOLERANCE and turned <= _TURN):
            return
        press.has_slid = True
        way, turn = f"slid {_MM * slid:.0f} mm", f"turned {np.rad2deg(turned):.0f}°"
        far = way if slid > _TOLERANCE else turn
        press.problem = f"{far} under pressure: let go before you move on"
        self.faults.append(Fault(look.time, press.problem))

    def _check_force(self, look: _Look) -> None:
        limit = self._task.force_limit
        was_over, self._is_over = self._is_over, look.peak > limit
        if not self._is_over:
            return
        problem = f"{look.peak:.1f} N, over {limit:g} N: press less"
        if not was_over:
            self.faults.append(Fault(look.time, problem))
        if self._press is not None and not self._press.problem:
            self._press.problem = problem

    def _find_pressed(self) -> _Point | None:
        """Return the point that the press is at."""
        along = np.nan if self._press is None else self._press.begin.along
        nearest = min(self._points, key=lambda point: abs(point.at - along))
        return nearest if abs(nearest.at - along) <= _TOLERANCE else None

    def _finish(self, press: _Press) -> None:
        """Note the result of the press at its point."""
        point = self._find_pressed()
        self._press, self._was_lifted = None, False
        if point is None or point.is_done:
            return
        point.most = press.most
        is_seen = press.closed is not None or press.is_hard
        point.is_examined |= is_seen and not press.problem
        point.is_done, point.seen = self._judge(press, point)

    def _judge(self, press: _Press, point: _Point) -> tuple[bool, str]:
        """Return whether the point is done, and words for what was seen."""
        seen = press.describe()
        if press.problem:
            return False, press.problem
        if press.closed is not None:
            if (left := press.closed[1]) >= _OPEN:
                return True, seen
            return False, f"{seen}, and of the {self._task.artery} {100 * left:.0f} % were left"
        if press.least <= WALLS_TOUCH:
            return False, f"closed{_format_force(press.force)} too shortly to be seen"
        if not press.is_hard:
            return False, f"{seen}: not pressed hard and long enough"
        is_thrombus = self._has_thrombus(point)
        return is_thrombus, f"{seen}: {'a thrombus' if is_thrombus else 'not closed'}"

    def _has_thrombus(self, point: _Point) -> bool:
        begin, end = self._thrombus
        return begin - _TOLERANCE <= point.at <= end + _TOLERANCE


def _format_force(force: float) -> str:
    return f" at {force:.1f} N" if np.isfinite(force) else ""
