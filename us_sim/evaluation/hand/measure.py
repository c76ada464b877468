"""Tissue that follows a random motion of a hand: first with every pose, then live.

Nodes are compared with the converged answer: ``fem_nonlinear``, with settings with which it
converges, follows the poses in order, and is called at each until it has converged or stalls.

>>> from us_sim.evaluation.hand.measure import list_motions
>>> list_motions(quick=True, seed=1)[0]
ArmMotion(kind='free', haste='brisk', seed=1, duration=2.0)
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from us_sim.evaluation.hand.hand_motion import APPROACH, HASTES, KINDS, RATE, make_hand_motion
from us_sim.evaluation.tissue_methods import TISSUE_METHODS
from us_sim.geometry.pose import Pose
from us_sim.scene.building import build_tissue_model, load_volume
from us_sim.scene.reading import load_scene
from us_sim.tissue.mesh.tetrahedral_mesh import signed_volumes
from us_sim.tissue.model import Deformation, TissueModel
from us_sim.tissue.solvers.frame_budget import FramePace
from us_sim.tissue.solvers.solver import TissueSolver, create_solver

METHOD = "fem_nonlinear"  # the method whose converged frames are the answer
FIRST = round(APPROACH * RATE)  # number of the first frame that counts, after the approach
CONVERGED = 1e-5  # residual at which a pose is left for the next
TRUSTED = 1e-3  # residual of the answer above which nothing is compared with it
AWAY = 1.0  # mm to the converged answer, above which a node counts as away

_Array = NDArray[np.float64]


@cache
def load_arm() -> TissueModel:
    """Load the tissue of the scene ``upper_arm``."""
    scene = load_scene("upper_arm")
    return build_tissue_model(scene, load_volume(scene))


@dataclass(frozen=True)
class ArmMotion:
    """A motion on the arm."""

    kind: str  # of `us_sim.evaluation.hand.hand_motion.KINDS`
    haste: str  # of `us_sim.evaluation.hand.hand_motion.HASTES`
    seed: int
    duration: float  # s, without the approach

    @cached_property
    def poses(self) -> list[Pose]:
        """Poses, one a frame, those of the approach first."""
        return make_hand_motion(self.kind, self.haste, self.seed, self.duration)


def list_motions(quick: bool, seed: int) -> list[ArmMotion]:
    """List the motions: the free hand in every haste, other kinds in the middle one."""
    if quick:
        return [
            ArmMotion("free", "brisk", seed, 2.0),
            ArmMotion("free", "violent", seed, 0.7),
            ArmMotion("tilting", "brisk", seed, 0.7),
        ]
    found = [ArmMotion("free", haste, seed, 8.0) for haste in HASTES]
    return found + [ArmMotion(kind, "brisk", seed, 4.0) for kind in KINDS if kind != "free"]


@dataclass(frozen=True, eq=False)
class ConvergedAnswer:
    """The converged answer at each of K poses."""

    nodes: _Array  # (K, N, 3) m
    residual: _Array  # (K,) as the solver reported it


def follow_to_convergence(model: TissueModel, poses: Sequence[Pose]) -> ConvergedAnswer:
    """Follow the poses, each to convergence."""
    solver = create_solver(METHOD, model, **TISSUE_METHODS[METHOD].converging)
    found = [_settle_at(solver, pose) for pose in poses]
    nodes = np.array([deformation.nodes for deformation in found])
    return ConvergedAnswer(nodes, np.array([deformation.residual for deformation in found]))


def _settle_at(solver: TissueSolver, pose: Pose) -> Deformation:
    """Return the best of up to 20 frames at one pose, until the solver settles or stalls.

    Of frames in balance the last is the best: in earlier ones the probe is still sunk in. The
    solver stalls if the least residual has not fallen to 0.7 of itself in four calls.
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


class FollowedFrame(NamedTuple):
    """One frame of a motion; an error is NaN where there is no converged answer."""

    number: int  # of the pose
    error: float  # mm, of the node that is farthest off
    residual: float  # as reported
    inverted: int  # tetrahedra that are inside out or flat
    cpu: float  # ms, processor time of all threads
    wall: float  # ms


def follow_motion(
    solver: TissueSolver, motion: ArmMotion, answer: ConvergedAnswer
) -> dict[str, Any]:
    """Follow a motion twice from rest, once with every pose and once live.

    Args:
        solver: of the method.
        motion: of the probe.
        answer: the converged one at each of its poses.

    Returns:
        The row, with both tables of `FollowedFrame`s.

    Raises:
        FloatingPointError: nodes that the solver returned are not finite.
    """
    frames, live = _follow_every_pose(solver, motion, answer), _follow_live(solver, motion, answer)
    return {
        "frames": len(frames),
        **_name_percentiles("error_mm", frames["error"], (50, 95, 99, 100)),
        "not_compared": int(frames["error"].isna().sum()),
        **_name_percentiles("residual", frames["residual"], (50, 99, 100)),
        **{
            f"residual_over_{limit:g}": float((frames["residual"] > limit).mean())
            for limit in (1e-2, 0.1, 1.0)
        },
        "frames_inverted": int((frames["inverted"] > 0).sum()),
        **_name_percentiles("cpu_ms", frames["cpu"], (50, 99, 100)),
        **_name_percentiles("wall_ms", frames["wall"], (50, 99, 100)),
        "live_skipped": 1.0 - len(live) / (len(motion.poses) - FIRST),
        **_name_percentiles("live_error_mm", live["error"], (50, 100)),
        "live_away_ms": compute_longest_away(live),
        **_name_percentiles("live_latency_ms", live["latency"], (50, 99, 100)),
        "live_frames_inverted": int((live["inverted"] > 0).sum()),
        "every": frames,
        "live": live,
    }


def _name_percentiles(
    name: str, values: pd.Series[float], percents: Sequence[int]
) -> dict[str, object]:
    """Return percentiles by column: ``name_p50``, and ``name_worst`` for 100."""
    return {
        f"{name}_{'worst' if p == 100 else f'p{p}'}": values.quantile(p / 100) for p in percents
    }


def compute_longest_away(live: pd.DataFrame) -> float:
    """Compute the longest time (ms) in which a shown node is over `AWAY` from its answer."""
    number = live["number"].to_numpy()
    longest, lasted = 0, 0  # poses
    until = np.append(number, number[-1:] + 1)[1:]  # the next is shown
    for poses, error in zip(until - number, live["error"], strict=True):
        lasted = lasted + poses if error > AWAY else 0
        longest = max(longest, lasted)
    return 1e3 * longest / RATE


def _follow_every_pose(
    solver: TissueSolver, motion: ArmMotion, answer: ConvergedAnswer
) -> pd.DataFrame:
    """Follow every pose, however long a frame takes."""
    solver.reset()
    rows = [_measure_frame(solver, motion, answer, k) for k in range(len(motion.poses))]
    return pd.DataFrame(rows[FIRST:], columns=FollowedFrame._fields)


def _follow_live(solver: TissueSolver, motion: ArmMotion, answer: ConvergedAnswer) -> pd.DataFrame:
    """Follow poses at their times, in each frame the newest; with the ``latency``, ms.

    The clock runs while a frame is made, and skips the wait for a pose. `FramePace` limits the time
    of a frame, as in the node, which needs 0.5 ms to send its result.
    """
    solver.reset()
    rows: list[dict[str, float]] = []
    now, done = 0.0, -1
    pace = FramePace(sending=0.0005)
    while done < len(motion.poses) - 1:
        newest = int(now * RATE + 1e-9)
        if newest <= done:
            newest, now = done + 1, (done + 1) / RATE
        if newest >= len(motion.poses):
            break
        solver.frame_limit = pace.limit
        row = _measure_frame(solver, motion, answer, newest)
        now += 1e-3 * row.wall
        pace.count_frame(1e-3 * row.wall)
        done = newest
        rows.append({**row._asdict(), "latency": 1e3 * (now - newest / RATE)})
    solver.frame_limit = None
    frames = pd.DataFrame(rows)
    return frames[frames["number"] >= FIRST].reset_index(drop=True)


def _measure_frame(
    solver: TissueSolver, motion: ArmMotion, answer: ConvergedAnswer, k: int
) -> FollowedFrame:
    begun, processor = time.perf_counter(), time.process_time()
    found = solver.deform(motion.poses[k])
    processor, wall = time.process_time() - processor, time.perf_counter() - begun
    if not np.isfinite(found.nodes).all():
        raise FloatingPointError(f"frame {k} is not finite")
    error = math.nan
    if answer.residual[k] <= TRUSTED:
        error = float(np.linalg.norm(found.nodes - answer.nodes[k], axis=1).max())
    inverted = signed_volumes(found.nodes, solver.model.mesh.tetrahedra) <= 0
    return FollowedFrame(
        k, 1e3 * error, found.residual, int(inverted.sum()), 1e3 * processor, 1e3 * wall
    )


@lru_cache(1)
def _compute_answer(motion: ArmMotion) -> ConvergedAnswer:
    return follow_to_convergence(load_arm(), motion.poses)


@cache
def _make_solver(method: str) -> TissueSolver:
    solver = create_solver(method, load_arm())
    solver.warm_up()
    return solver


def measure_motion(motion: ArmMotion, method: str) -> list[dict[str, Any]]:
    """Measure the row of a method; keep the answer of the last motion, and the solvers."""
    with threadpool_limits(1):
        return [follow_motion(_make_solver(method), motion, _compute_answer(motion))]
