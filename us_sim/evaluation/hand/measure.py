"""How tissue follows a random motion of a hand: every pose fed, then live, then the probe held.

Nodes are compared with the converged answer: a ``fem_nonlinear`` with the settings with which it
converges follows the poses in order, and is called again at each until it has converged, or goes no
further.

>>> from us_sim.evaluation.hand.measure import TISSUES, Held, motions
>>> [str(motion) for motion in motions(quick=True, seed=1)][0]
'arm, free, brisk'
>>> held = Held(np.array([0.3, 0.02, 5e-4, 1e-6]))
>>> held.frames_to(1e-2), held.frames_to(1e-8)
(2.0, nan)
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from us_sim.evaluation.block import EXTENT, MESHES
from us_sim.evaluation.hand.hand_motion import HASTES, KINDS, RATE, Room, hand_motion
from us_sim.evaluation.report import Row, percentile, words_of
from us_sim.evaluation.timing import frames_until
from us_sim.evaluation.tissue.cases import SCENES
from us_sim.evaluation.tissue_methods import TISSUE_METHODS
from us_sim.geometry.pose import Pose
from us_sim.scene.building import tissue_model_of, volume_of
from us_sim.scene.reading import find_scene, load_scene
from us_sim.tissue.mesh.tetrahedral_mesh import signed_volumes
from us_sim.tissue.model import Deformation, TissueModel
from us_sim.tissue.solvers.frame_budget import Pace
from us_sim.tissue.solvers.solver import TissueSolver, create_solver
from us_sim.volume.volume import Volume

MAIN_TISSUE = "arm"
METHOD = "fem_nonlinear"  # the method whose converged frames are the answer
APPROACH = 0.5  # s, in which the probe comes to where a motion begins: these frames do not count
CONVERGED = 1e-5  # residual at which a pose is left for the next
TRUSTED = 1e-3  # residual of the answer above which nothing is compared with it
HELD = 1e-6  # m that a fixed node may move before nothing is compared with it either
ENOUGH = 0.9  # fraction of the frames that must be compared before their errors are reported
AWAY = 1.0  # mm to the converged answer, beyond which tissue is elsewhere
HOLD = 60  # frames in which the probe stays at its last pose
OWN_EVERY = 5  # frames, of which one is converged by itself

_QUICK_MOTIONS = (
    (MAIN_TISSUE, "free", "brisk", 2.0),
    (MAIN_TISSUE, "free", "violent", 0.7),
    (MAIN_TISSUE, "rocking", "careful", 0.7),
    ("liver", "fanning", "brisk", 0.5),
    ("block", "sliding", "brisk", 0.7),
    ("block", "stabbing", "violent", 0.7),
)

_Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Tissue:
    """A tissue, its name in a report, and how far the hand may go on it."""

    name: str
    words: str
    colour: str
    make: Callable[[], TissueModel]
    room: Room

    @cached_property
    def model(self) -> TissueModel:
        """The model, made once.

        Raises:
            UsSimError: it cannot be made.
        """
        return self.make()


def _arm() -> TissueModel:
    scene = load_scene("upper_arm")
    return tissue_model_of(scene, volume_of(scene))


def _liver() -> TissueModel:
    # The scene's volume is not part of the package. It has no labels, so that the tissue is uniform
    # and needs nothing of it: any file stands for it, and an empty volume.
    scene = load_scene("liver_sweep", volume=find_scene("liver_sweep"))
    return tissue_model_of(scene, Volume(np.zeros((1, 1, 1), np.uint8), np.eye(4)))


_ALL = (
    Tissue(
        MAIN_TISSUE,
        "the scene `upper_arm` with its linear probe: skin, fat, muscle, vessels, bone",
        "#0072B2",
        _arm,
        Room(),
    ),
    Tissue(
        "liver",
        "the block of the scene `liver_sweep` with its convex probe: uniform, 6 kPa, held at its "
        "bottom",
        "#009E73",
        _liver,
        Room(edge=0.12),
    ),
    Tissue(
        "block",
        "the uniform block of `us-sim evaluate tissue`, 10 kPa, under a capsule of 25 mm radius",
        "#D55E00",
        lambda: SCENES["tilt"].model(MESHES[0]),
        Room(edge=EXTENT[0][1]),
    ),
)
TISSUES = {tissue.name: tissue for tissue in _ALL}


@dataclass(frozen=True)
class Motion:
    """A motion on a tissue."""

    tissue: str
    kind: str  # of `us_sim.evaluation.hand.hand_motion.KINDS`
    haste: str  # of `us_sim.evaluation.hand.hand_motion.HASTES`
    seed: int
    duration: float  # s, without the approach

    def __str__(self) -> str:
        return f"{self.tissue}, {self.kind}, {self.haste}"

    @cached_property
    def poses(self) -> list[Pose]:
        """One pose a frame, those of the approach first."""
        room = TISSUES[self.tissue].room
        return hand_motion(
            self.kind, self.haste, self.seed, self.duration, room, approach=APPROACH
        ).poses

    @property
    def begins(self) -> int:
        """The frame after the approach."""
        return round(APPROACH * RATE)

    @property
    def speeds(self) -> tuple[_Array, _Array]:
        """m/s and rad/s, from each frame that counts to the next."""
        poses = self.poses[self.begins :]
        places = np.array([pose.position for pose in poses])
        turns = np.array([pose.orientation for pose in poses])
        cosine = np.abs((turns[1:] * turns[:-1]).sum(axis=1)).clip(0.0, 1.0)
        moved = np.linalg.norm(np.diff(places, axis=0), axis=1)
        return np.asarray(RATE * moved), np.asarray(RATE * 2 * np.arccos(cosine))


def motions(quick: bool, seed: int) -> list[Motion]:
    """All motions that are measured, in order: a tissue's motions stand together.

    The free hand in every haste on every tissue, the longest on the main one; there every kind in
    every haste, elsewhere every kind in the middle one.
    """
    if quick:
        rows = list(_QUICK_MOTIONS)
    else:
        rows = [
            (tissue, kind, haste, 10.0 if kind == "free" and tissue == MAIN_TISSUE else 4.0)
            for tissue in TISSUES
            for kind in KINDS
            for haste in HASTES
            if tissue == MAIN_TISSUE or kind == "free" or haste == "brisk"
        ]
    order = list(TISSUES)
    found = [Motion(tissue, kind, haste, seed, length) for tissue, kind, haste, length in rows]
    return sorted(found, key=lambda motion: order.index(motion.tissue))


@dataclass(frozen=True, eq=False)
class Converged:
    """The converged answer at each of K poses."""

    nodes: _Array  # (K, N, 3) m
    residual: _Array  # (K,) as the solver said in the end
    pressed: NDArray[np.bool_]  # (K,) whether the probe touches the tissue
    smallest: _Array  # (K,) volume ratio of the tetrahedron most crushed
    slipped: _Array  # (K,) m, of the fixed node that moved most

    @classmethod
    def of_no_frame(cls, count: int) -> Converged:
        """In place of an answer that failed: nothing is compared with it."""
        never, unknown = np.zeros(count, dtype=np.bool_), np.full(count, np.nan)
        return cls(np.empty((count, 0, 3)), np.full(count, np.inf), never, unknown, unknown)

    @property
    def trusted(self) -> NDArray[np.bool_]:
        """(K,) whether frames may be compared with it."""
        return (self.residual <= TRUSTED) & (self.slipped <= HELD)

    @property
    def last_pressed(self) -> int:
        """The last frame in which the probe touches; the last of all where it never does."""
        touching = np.flatnonzero(self.pressed)
        return int(touching[-1]) if len(touching) else len(self.pressed) - 1


def converged(
    model: TissueModel, poses: Sequence[Pose], progress: Callable[[int], None] = lambda _: None
) -> Converged:
    """Follow the poses, each to convergence; ``progress`` is told how many are done.

    Raises:
        UsSimError: the method does not take the tissue.
    """
    solver = _patient_solver(model)
    count = len(poses)
    nodes, pressed = np.empty((count, *model.mesh.nodes.shape)), np.zeros(count, dtype=np.bool_)
    residual, smallest, slipped = np.empty((3, count))
    for k, pose in enumerate(poses):
        found = _settled(solver, pose)
        nodes[k], residual[k] = found.nodes, found.residual
        pressed[k] = len(found.contact_nodes) > 0
        volumes = signed_volumes(found.nodes, model.mesh.tetrahedra)
        smallest[k] = (volumes / model.mesh.volumes).min()
        slipped[k] = _moved_fixed(model, found)
        progress(k + 1)
    return Converged(nodes, residual, pressed, smallest, slipped)


def _moved_fixed(model: TissueModel, found: Deformation) -> float:
    """m, of the fixed node that moved most: none should."""
    return float(np.abs(found.nodes - model.mesh.nodes)[model.fixed].max(initial=0.0))


def _patient_solver(model: TissueModel) -> TissueSolver:
    return create_solver(METHOD, model, **(TISSUE_METHODS[METHOD].patient or {}))


def _settled(solver: TissueSolver, pose: Pose) -> Deformation:
    """The best of up to 20 frames at one pose: until it settles, or goes no further.

    Of frames in balance the last is the best: in the earlier ones the probe is still sunk in. It
    goes no further where in four calls the least residual has not fallen by a factor of 0.7.
    """
    found = solver.deform(pose)
    best = [found]
    for _ in range(19):
        stalled = len(best) > 4 and best[-1].residual > max(CONVERGED, 0.7 * best[-5].residual)
        if solver.is_settled or stalled:
            break
        found = solver.deform(pose)
        balanced = found.residual <= CONVERGED
        best.append(found if balanced else min(best[-1], found, key=lambda each: each.residual))
    return best[-1]


def _unknown() -> _Array:
    return np.empty(0)


@dataclass(frozen=True, eq=False)
class Frames:
    """Frames of a motion, each array (K,); an error is NaN where there is no converged answer."""

    number: NDArray[np.intp] = field(default_factory=lambda: np.empty(0, np.intp))  # of the pose
    error: _Array = field(default_factory=_unknown)  # mm, of the node that is farthest off
    rms: _Array = field(default_factory=_unknown)  # mm, root mean square over all nodes
    own: _Array = field(default_factory=_unknown)  # mm, to its own balance; NaN in most frames
    residual: _Array = field(default_factory=_unknown)  # as reported
    inverted: _Array = field(default_factory=_unknown)  # tetrahedra
    slipped: _Array = field(default_factory=_unknown)  # mm, of the fixed node that moved most
    cpu: _Array = field(default_factory=_unknown)  # ms, processor time of all threads
    wall: _Array = field(default_factory=_unknown)  # ms

    @classmethod
    def of(cls, rows: Sequence[tuple[float, ...]]) -> Frames:
        """From rows in the order of the fields."""
        if not rows:
            return cls()
        number, *others = np.array(rows).T
        return cls(number.astype(np.intp), *others)

    @property
    def compared(self) -> float:
        """Fraction of the frames that have an error."""
        return float(np.isfinite(self.error).mean()) if len(self.error) else 0.0


@dataclass(frozen=True, eq=False)
class Live:
    """A motion in which a frame that takes long costs poses."""

    poses: int = 0  # that came
    frames: Frames = field(default_factory=Frames)  # that were made
    latency: _Array = field(default_factory=_unknown)  # (K,) ms, from a pose to its frame

    @property
    def skipped(self) -> float:
        """Fraction of the poses without a frame."""
        return 1.0 - len(self.frames.number) / self.poses if self.poses else math.nan

    @property
    def away(self) -> float:
        """The longest time (ms) that a node is shown farther than `AWAY` from where it belongs."""
        longest, lasted = 0, 0  # poses
        until = np.append(self.frames.number, self.frames.number[-1:] + 1)[1:]  # it is shown
        for poses, error in zip(until - self.frames.number, self.frames.error, strict=True):
            lasted = lasted + poses if error > AWAY else 0
            longest = max(longest, lasted)
        return 1e3 * longest / RATE


@dataclass(frozen=True, eq=False)
class Held:
    """Frames after the probe has stopped."""

    residual: _Array = field(default_factory=_unknown)  # (K,), that of the frame before them first
    inverted: int = 0  # tetrahedra in the last of them

    def frames_to(self, residual: float) -> float:
        """Frames until it is as small, and stays so; NaN where it never is."""
        found = frames_until(self.residual, residual)
        return math.nan if found is None else float(found)


@dataclass(frozen=True, eq=False)
class Point(Row):
    """A row of hand.csv."""

    motion: Motion
    method: str
    speed: float = math.nan  # m/s, median of the frames that count
    turning: float = math.nan  # rad/s, likewise
    frames: Frames = field(default_factory=Frames)
    live: Live = field(default_factory=Live)
    held: Held = field(default_factory=Held)
    failure: str = ""

    @property
    def values(self) -> dict[str, object]:
        frames, live, held, motion = self.frames, self.live, self.held, self.motion
        over = {
            f"residual_over_{limit:g}": (
                float((frames.residual > limit).mean()) if len(frames.residual) else math.nan
            )
            for limit in (1e-2, 0.1, 1.0)
        }
        return {
            "tissue": motion.tissue,
            "kind": motion.kind,
            "haste": motion.haste,
            "seed": motion.seed,
            "method": self.method,
            "frames": len(frames.number),
            "speed_mm_s": 1e3 * self.speed,
            "turning_deg_s": math.degrees(self.turning),
            **_percentiles("error_mm", frames.error, (50, 95, 99, 100)),
            **_percentiles("rms_mm", frames.rms, (50, 95, 99, 100)),
            "not_compared": int(np.isnan(frames.error).sum()),
            **_percentiles("own_error_mm", frames.own, (50, 100)),
            **_percentiles("residual", frames.residual, (50, 99, 100)),
            **over,
            "frames_inverted": int((frames.inverted > 0).sum()),
            "fixed_nodes_moved_mm": float(frames.slipped.max(initial=0.0)),
            **_percentiles("cpu_ms", frames.cpu, (50, 99, 100)),
            **_percentiles("wall_ms", frames.wall, (50, 99, 100)),
            "live_skipped": live.skipped,
            **_percentiles("live_error_mm", live.frames.error, (50, 100)),
            "live_away_ms": live.away,
            **_percentiles("live_latency_ms", live.latency, (50, 99, 100)),
            "live_frames_inverted": int((live.frames.inverted > 0).sum()),
            "hold_frames_to_1e-2": held.frames_to(1e-2),
            "hold_frames_to_1e-3": held.frames_to(1e-3),
            "hold_residual": float(held.residual[-1]) if len(held.residual) else math.nan,
            "hold_inverted": bool(held.inverted),
            "failure": self.failure,
        }

    @property
    def title(self) -> str:
        return f"{self.method}, {self.motion}"


def _percentiles(name: str, values: _Array, percents: Sequence[int]) -> dict[str, object]:
    """By column: ``name_p50``, and ``name_worst`` for 100."""
    known = values[~np.isnan(values)]
    return {f"{name}_{'worst' if p == 100 else f'p{p}'}": percentile(known, p) for p in percents}


def select(
    points: Iterable[Point], *, method: str | None = None, **motion: str | None
) -> list[Point]:
    """Points that did not fail, of this method, tissue, kind and haste; None is any."""
    return [
        p
        for p in points
        if not p.failure
        and method in (None, p.method)
        and all(value in (None, getattr(p.motion, name)) for name, value in motion.items())
    ]


def measure(
    solver: TissueSolver,
    motion: Motion,
    answer: Converged,
    balance: TissueSolver | None = None,
    progress: Callable[[int], None] = lambda _: None,
) -> Point:
    """Follow a motion twice from rest, once with every pose and once live, and hold the probe.

    Args:
        solver: of the method.
        motion: of the probe.
        answer: the converged one at each of its poses.
        balance: a solver of the same equations, with which frames are converged at their poses.
        progress: told how many poses have been fed.

    Raises:
        FloatingPointError: a number that the solver returned is not finite.
    """
    following = _Following(solver, motion, answer, balance)
    frames = following.every_pose(progress)
    held = following.held()
    live = following.live()
    speed, turning = (float(np.median(each)) for each in motion.speeds)
    return Point(motion, solver.name, speed, turning, frames, live, held)


class _Following:
    """One solver and one motion."""

    def __init__(
        self, solver: TissueSolver, motion: Motion, answer: Converged, balance: TissueSolver | None
    ) -> None:
        self._solver, self._motion, self._answer = solver, motion, answer
        self._balance, self._mesh = balance, solver.model.mesh
        self._last = solver.deform(None)

    def every_pose(self, progress: Callable[[int], None]) -> Frames:
        """No pose is left out, however long a frame takes; up to the last one that presses."""
        self._solver.reset()
        rows = []
        for k in range(self._answer.last_pressed + 1):
            row = self._frame(k, own_balance=k % OWN_EVERY == 0 and k >= self._motion.begins)
            if k >= self._motion.begins:
                rows.append(row)
            progress(k + 1)
        return Frames.of(rows)

    def held(self) -> Held:
        """The probe stays where the motion above ended."""
        pose, found = self._motion.poses[self._answer.last_pressed], self._last
        residual = [found.residual]
        for _ in range(HOLD):
            before, found = found, self._solver.deform(pose)
            if found is before:  # settled: it will not change any more
                break
            residual.append(found.residual)
        return Held(np.array(residual), self._inverted(found))

    def live(self) -> Live:
        """Poses come at their times, and a frame begins with the newest of them.

        The clock is the wall's while a frame is made; waiting for a pose takes no time. A frame may
        take as long as `Pace` says, as in the node, which needs 0.5 ms to send its result.
        """
        self._solver.reset()
        poses = self._motion.poses
        rows, latency = [], []
        now, done = 0.0, -1
        pace = Pace(sending=0.0005)
        while True:
            newest = int(now * RATE + 1e-9)
            if newest <= done:
                newest, now = done + 1, (done + 1) / RATE
            if newest >= len(poses):
                break
            self._solver.frame_limit = pace.limit
            row = self._frame(newest)
            now += 1e-3 * row[-1]
            pace.spend(1e-3 * row[-1])
            done = newest
            if newest >= self._motion.begins:
                rows.append(row)
                latency.append(1e3 * (now - newest / RATE))
        self._solver.frame_limit = None
        return Live(len(poses) - self._motion.begins, Frames.of(rows), np.array(latency))

    def _frame(self, k: int, *, own_balance: bool = False) -> tuple[float, ...]:
        pose = self._motion.poses[k]
        begun, processor = time.perf_counter(), time.process_time()
        found = self._solver.deform(pose)
        processor, wall = time.process_time() - processor, time.perf_counter() - begun
        self._last = found
        numbers = (found.nodes, found.force, found.torque, found.residual)
        if not all(np.isfinite(number).all() for number in numbers):
            raise FloatingPointError(f"frame {k} is not finite")
        error = rms = own = math.nan
        if own_balance and self._balance is not None:
            own = self._to_own_balance(self._balance, pose, found)
        if self._answer.trusted[k]:
            off = np.linalg.norm(found.nodes - self._answer.nodes[k], axis=1)
            error, rms = float(off.max()), float(np.sqrt((off**2).mean()))
        times = (1e3 * processor, 1e3 * wall)
        errors = (1e3 * error, 1e3 * rms, 1e3 * own)
        slipped = _moved_fixed(self._solver.model, found)
        return (k, *errors, found.residual, self._inverted(found), 1e3 * slipped, *times)

    def _to_own_balance(self, balance: TissueSolver, pose: Pose, found: Deformation) -> float:
        """m, from the frame to the converged one at its pose; NaN where it does not converge."""
        state = self._solver.state
        state.displacement[self._solver.model.fixed] = 0.0  # its motion has a column of its own
        balance.take_over(state)
        there = _settled(balance, pose)
        if there.residual > TRUSTED or _moved_fixed(self._solver.model, there) > HELD:
            return math.nan
        return float(np.linalg.norm(found.nodes - there.nodes, axis=1).max())

    def _inverted(self, found: Deformation) -> int:
        """Tetrahedra that are inside out or flat."""
        return int((signed_volumes(found.nodes, self._mesh.tetrahedra) <= 0).sum())


def measured_points(
    planned: Sequence[Motion],
    answers: dict[Motion, Converged],
    progress: Callable[[float, str], None],
) -> Iterator[Point]:
    """Every motion with every method; the converged answers are put into ``answers``."""
    done = 0
    bench = _Bench()
    for motion in planned:
        for method in (None, *TISSUE_METHODS):
            before, words = done, f"{motion}: {method or 'the converged answer'}"
            progress(before, words)

            def tell(count: int, before: int = before, words: str = words) -> None:
                progress(before + count, words)

            if method is None:
                answers[motion] = bench.answer(motion, tell)
            else:
                yield bench.point(motion, method, answers[motion], tell)
            done += len(motion.poses)


class _Bench:
    """Measures motions; keeps the last tissue's solvers."""

    def __init__(self) -> None:
        self._tissue = ""
        self._solvers: dict[str, TissueSolver] = {}
        self._patient: TissueSolver | None = None
        self._broken: dict[Motion, str] = {}

    def answer(self, motion: Motion, progress: Callable[[int], None]) -> Converged:
        """The converged answer; where it fails, one that no frame is compared with."""
        try:
            return converged(TISSUES[motion.tissue].model, motion.poses, progress)
        # Whatever breaks on one tissue must not take the others' results along.
        except Exception as error:
            self._broken[motion] = f"the converged answer with {METHOD}: {words_of(error)}"
            return Converged.of_no_frame(len(motion.poses))

    def point(
        self, motion: Motion, method: str, answer: Converged, progress: Callable[[int], None]
    ) -> Point:
        """A method's row."""
        if motion in self._broken:
            return Point(motion, method, failure=self._broken[motion])
        try:
            solver = self._solver(motion.tissue, method)
            balance = None
            if method == METHOD:  # the others solve other equations
                if self._patient is None:
                    self._patient = _patient_solver(TISSUES[motion.tissue].model)
                balance = self._patient
            return measure(solver, motion, answer, balance, progress)
        except Exception as error:
            self._solvers.pop(method, None)
            return Point(motion, method, failure=words_of(error))

    def _solver(self, tissue: str, method: str) -> TissueSolver:
        if tissue != self._tissue:
            self._tissue, self._solvers, self._patient = tissue, {}, None
        if method not in self._solvers:
            solver = create_solver(method, TISSUES[tissue].model)
            solver.warm_up()
            self._solvers[method] = solver
        return self._solvers[method]
