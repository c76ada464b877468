"""How tissue follows a random motion of a hand: every pose fed, then live, then the probe held.

Nodes are compared with the converged answer: a ``fem_nonlinear`` with the settings with which it
converges follows the poses in order, and is called again at each until it has converged, or goes no
further.

>>> from us_sim.evaluation.hand.measure import motions
>>> [str(motion) for motion in motions(quick=True, seed=1)][0]
'arm, free, brisk'
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from us_sim.evaluation.block import EXTENT, MESHES
from us_sim.evaluation.hand.hand_motion import HASTES, KINDS, RATE, Room, hand_motion
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
    """A tissue, its words in a report, and how far the hand may go on it."""

    words: str
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


TISSUES = {
    MAIN_TISSUE: Tissue(
        "the scene `upper_arm` with its linear probe: skin, fat, muscle, vessels, bone",
        _arm,
        Room(),
    ),
    "liver": Tissue(
        "the block of the scene `liver_sweep` with its convex probe: uniform, 6 kPa, held at its "
        "bottom",
        _liver,
        Room(edge=0.12),
    ),
    "block": Tissue(
        "the uniform block of `us-sim evaluate tissue`, 10 kPa, under a capsule of 25 mm radius",
        lambda: SCENES["tilt"].model(MESHES[0]),
        Room(edge=EXTENT[0][1]),
    ),
}


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
    slipped: _Array  # (K,) m, of the fixed node that moved most

    @property
    def trusted(self) -> NDArray[np.bool_]:
        """(K,) whether frames may be compared with it."""
        return (self.residual <= TRUSTED) & (self.slipped <= HELD)

    @property
    def last_pressed(self) -> int:
        """The last frame in which the probe touches; the last of all where it never does."""
        touching = np.flatnonzero(self.pressed)
        return int(touching[-1]) if len(touching) else len(self.pressed) - 1


def converged(model: TissueModel, poses: Sequence[Pose]) -> Converged:
    """Follow the poses, each to convergence.

    Raises:
        UsSimError: the method does not take the tissue.
    """
    solver = _patient_solver(model)
    count = len(poses)
    nodes, pressed = np.empty((count, *model.mesh.nodes.shape)), np.zeros(count, dtype=np.bool_)
    residual, slipped = np.empty((2, count))
    for k, pose in enumerate(poses):
        found = _settled(solver, pose)
        nodes[k], residual[k] = found.nodes, found.residual
        pressed[k] = len(found.contact_nodes) > 0
        slipped[k] = _moved_fixed(model, found)
    return Converged(nodes, residual, pressed, slipped)


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


def follow(
    solver: TissueSolver, motion: Motion, answer: Converged, balance: TissueSolver | None = None
) -> dict[str, Any]:
    """Follow a motion twice from rest, once with every pose and once live, and hold the probe.

    Args:
        solver: of the method.
        motion: of the probe.
        answer: the converged one at each of its poses.
        balance: a solver of the same equations, with which frames are converged at their poses.

    Returns:
        The row, with both tables of `Frame`s and the residuals while the probe is held.

    Raises:
        FloatingPointError: a number that the solver returned is not finite.
    """
    following = _Following(solver, motion, answer, balance)
    frames = following.every_pose()
    residual, inverted = following.held()
    live, latency = following.live()
    speed, turning = (float(np.median(each)) for each in motion.speeds)
    poses = len(motion.poses) - motion.begins
    until = [frames_until(residual, small) for small in (1e-2, 1e-3)]
    return {
        "frames": len(frames),
        "speed_mm_s": 1e3 * speed,
        "turning_deg_s": math.degrees(turning),
        **_percentiles("error_mm", frames["error"], (50, 95, 99, 100)),
        **_percentiles("rms_mm", frames["rms"], (50, 95, 99, 100)),
        "not_compared": int(frames["error"].isna().sum()),
        **_percentiles("own_error_mm", frames["own"], (50, 100)),
        **_percentiles("residual", frames["residual"], (50, 99, 100)),
        **{
            f"residual_over_{limit:g}": float((frames["residual"] > limit).mean())
            for limit in (1e-2, 0.1, 1.0)
        },
        "frames_inverted": int((frames["inverted"] > 0).sum()),
        "fixed_nodes_moved_mm": float(frames["slipped"].max()),
        **_percentiles("cpu_ms", frames["cpu"], (50, 99, 100)),
        **_percentiles("wall_ms", frames["wall"], (50, 99, 100)),
        "live_skipped": 1.0 - len(live) / poses,
        **_percentiles("live_error_mm", live["error"], (50, 100)),
        "live_away_ms": longest_away(live),
        **_percentiles("live_latency_ms", latency, (50, 99, 100)),
        "live_frames_inverted": int((live["inverted"] > 0).sum()),
        "hold_frames_to_1e-2": until[0],
        "hold_frames_to_1e-3": until[1],
        "hold_residual": float(residual[-1]),
        "hold_inverted": inverted > 0,
        "every": frames.assign(s=(frames["number"] - motion.begins) / RATE),
        "live": live.assign(latency=latency),
        "hold": residual,
    }


def _percentiles(name: str, values: pd.Series[float], percents: Sequence[int]) -> dict[str, object]:
    """By column: ``name_p50``, and ``name_worst`` for 100."""
    return {
        f"{name}_{'worst' if p == 100 else f'p{p}'}": values.quantile(p / 100) for p in percents
    }


def longest_away(live: pd.DataFrame) -> float:
    """The longest time (ms) that a node is shown farther than `AWAY` from where it belongs."""
    number = live["number"].to_numpy()
    longest, lasted = 0, 0  # poses
    until = np.append(number, number[-1:] + 1)[1:]  # it is shown
    for poses, error in zip(until - number, live["error"], strict=True):
        lasted = lasted + poses if error > AWAY else 0
        longest = max(longest, lasted)
    return 1e3 * longest / RATE


class Frame(NamedTuple):
    """One frame of a motion; an error is NaN where there is no converged answer."""

    number: int  # of the pose
    error: float  # mm, of the node that is farthest off
    rms: float  # mm, root mean square over all nodes
    own: float  # mm, to its own balance; NaN in most frames
    residual: float  # as reported
    inverted: int  # tetrahedra
    slipped: float  # mm, of the fixed node that moved most
    cpu: float  # ms, processor time of all threads
    wall: float  # ms


class _Following:
    """One solver and one motion."""

    def __init__(
        self, solver: TissueSolver, motion: Motion, answer: Converged, balance: TissueSolver | None
    ) -> None:
        self._solver, self._motion, self._answer = solver, motion, answer
        self._balance, self._mesh = balance, solver.model.mesh
        self._last = solver.deform(None)

    def every_pose(self) -> pd.DataFrame:
        """No pose is left out, however long a frame takes; up to the last one that presses."""
        self._solver.reset()
        rows = []
        for k in range(self._answer.last_pressed + 1):
            row = self._frame(k, own_balance=k % OWN_EVERY == 0 and k >= self._motion.begins)
            if k >= self._motion.begins:
                rows.append(row)
        return pd.DataFrame(rows, columns=Frame._fields)

    def held(self) -> tuple[_Array, int]:
        """Hold the probe where the motion above ended.

        Returns:
            The residual, that of the frame before first, and tetrahedra that are inverted then.
        """
        pose, found = self._motion.poses[self._answer.last_pressed], self._last
        residual = [found.residual]
        for _ in range(HOLD):
            before, found = found, self._solver.deform(pose)
            if found is before:  # settled: it will not change any more
                break
            residual.append(found.residual)
        return np.array(residual), self._inverted(found)

    def live(self) -> tuple[pd.DataFrame, pd.Series[float]]:
        """Take poses at their times, each frame the newest of them.

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
            now += 1e-3 * row.wall
            pace.spend(1e-3 * row.wall)
            done = newest
            if newest >= self._motion.begins:
                rows.append(row)
                latency.append(1e3 * (now - newest / RATE))
        self._solver.frame_limit = None
        return pd.DataFrame(rows, columns=Frame._fields), pd.Series(latency, dtype=float)

    def _frame(self, k: int, *, own_balance: bool = False) -> Frame:
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
        return Frame(
            number=k,
            error=1e3 * error,
            rms=1e3 * rms,
            own=1e3 * own,
            residual=found.residual,
            inverted=self._inverted(found),
            slipped=1e3 * _moved_fixed(self._solver.model, found),
            cpu=1e3 * processor,
            wall=1e3 * wall,
        )

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


class Bench:
    """Measures motions; keeps the last motion's answer, and the last tissue's solvers."""

    def __init__(self) -> None:
        self._answers: dict[Motion, Converged] = {}
        self._solvers: dict[tuple[str, str], TissueSolver] = {}

    def row(self, motion: Motion, method: str) -> list[dict[str, Any]]:
        """Row of a method."""
        model = TISSUES[motion.tissue].model
        with threadpool_limits(1):
            if motion not in self._answers:
                self._answers = {motion: converged(model, motion.poses)}
            if (motion.tissue, method) not in self._solvers:
                kept = self._solvers.items()
                self._solvers = {key: each for key, each in kept if key[0] == motion.tissue}
                solver = create_solver(method, model)
                solver.warm_up()
                self._solvers[motion.tissue, method] = solver
            # The others solve other equations.
            balance = _patient_solver(model) if method == METHOD else None
            solver = self._solvers[motion.tissue, method]
            return [follow(solver, motion, self._answers[motion], balance)]
