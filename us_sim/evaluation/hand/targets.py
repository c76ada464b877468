"""What is asked of ``fem_nonlinear`` in a hand, against what was seen in one run."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from us_sim.evaluation.hand.cases import MAIN_TISSUE
from us_sim.evaluation.hand.points import ENOUGH, Point, those
from us_sim.evaluation.target import Target

JUDGED = "fem_nonlinear"
"""The method that the targets are for."""


def targets(points: Sequence[Point]) -> list[Target]:
    """Every measure that is asked for."""
    mine = those(points, method=JUDGED)
    brisk = those(mine, tissue=MAIN_TISSUE, haste="brisk")
    careful = those(mine, tissue=MAIN_TISSUE, haste="careful")
    violent = those(mine, haste="violent")
    where = f"brisk on the {MAIN_TISSUE}"
    return [
        _fraction(f"{where}: % of frames with a residual of at most 0.01", 99.0, brisk, 1e-2),
        _fraction(f"{where}: likewise 0.1", 100.0, brisk, 0.1),
        _most(f"{where}: ms a frame (processor), median", 8, brisk, _cpu, 50, "ms"),
        _most(f"{where}: likewise, 99th percentile", 33, brisk, _cpu, 99, "ms"),
        _most(f"{where}: mm to its own balance, median", 0.05, brisk, _own, 50, "mm"),
        _most(f"{where}: likewise, 99th percentile", 0.5, brisk, _own, 99, "mm"),
        _fraction(f"careful on the {MAIN_TISSUE}: % with at most 0.01", 99.9, careful, 1e-2),
        _off(f"live, {where}: mm to the converged answer, median", 0.05, brisk, 50),
        _off(f"live, {where}: likewise, 99th percentile", 0.5, brisk, 99),
        _most(
            *(f"live, {where}: ms from a pose to its nodes, 99th percentile", 25, brisk),
            *(lambda p: p.live.latency, 99, "ms"),
        ),
        Target.at_most(f"live, {where}: % of poses skipped", 5, _skipped(brisk)),
        Target.at_most("all motions: frames with inverted tetrahedra", 0, _inverted(mine)),
        _most("violent: ms of the slowest frame", 50, violent, lambda p: p.frames.wall, 100, "ms"),
        _most("all motions: mm that a fixed node moves", 0, mine, _slipped, 100, "mm"),
        _rest("violent, then held: frames to a residual of 0.01, worst", 5, violent, 1e-2),
        _rest("all motions, then held: frames to a residual of 0.001, worst", 30, mine, 1e-3),
        Target.at_most(
            "all motions, then held: inverted in the end",
            0,
            sum(p.held.inverted > 0 for p in mine) if mine else np.nan,
        ),
    ]


def _cpu(point: Point) -> NDArray[np.float64]:
    return point.frames.cpu


def _error(point: Point) -> NDArray[np.float64]:
    return point.live.frames.error


def _own(point: Point) -> NDArray[np.float64]:
    return point.frames.own


def _slipped(point: Point) -> NDArray[np.float64]:
    return point.frames.slipped


def _together(
    points: Sequence[Point], values: Callable[[Point], NDArray[np.float64]]
) -> NDArray[np.float64]:
    """The values of all frames that are known."""
    found = np.concatenate([values(p) for p in points]) if points else np.empty(0)
    return np.asarray(found[~np.isnan(found)])


def _fraction(what: str, asked: float, points: Sequence[Point], limit: float) -> Target:
    residual = _together(points, lambda p: p.frames.residual)
    seen = 100 * float((residual <= limit).mean()) if len(residual) else np.nan
    return Target.at_least(what, asked, seen, form=".4g")


def _most(
    what: str,
    limit: float,
    points: Sequence[Point],
    values: Callable[[Point], NDArray[np.float64]],
    percent: float,
    unit: str,
) -> Target:
    found = _together(points, values)
    seen = float(np.percentile(found, percent)) if len(found) else np.nan
    return Target.at_most(what, limit, seen, unit)


def _off(what: str, limit: float, points: Sequence[Point], percent: float) -> Target:
    """An error, where enough frames have one."""
    every = np.concatenate([_error(p) for p in points]) if points else np.empty(0)
    known = float(np.isfinite(every).mean()) if len(every) else 1.0
    if known < ENOUGH:
        seen = f"no converged answer for {100 * (1 - known):.0f} % of the frames"
        return Target(what, f"at most {limit:g} mm", seen)
    return _most(what, limit, points, _error, percent, "mm")


def _skipped(points: Sequence[Point]) -> float:
    """% of the poses of all motions."""
    came = sum(p.live.poses for p in points)
    return 100 * (1 - sum(len(p.live.frames.number) for p in points) / came) if came else np.nan


def _inverted(points: Sequence[Point]) -> float:
    frames = [each for p in points for each in (p.frames, p.live.frames)]
    return sum(int((each.inverted > 0).sum()) for each in frames) if frames else np.nan


def _rest(what: str, limit: int, points: Sequence[Point], residual: float) -> Target:
    """Frames after the probe has stopped; never, where a residual never is as small."""
    found = np.array([p.held.frames_to(residual) for p in points])
    never = int(np.isnan(found).sum())
    if not never:
        return Target.at_most(what, limit, found.max() if len(found) else np.nan, form="g")
    return Target(what, f"at most {limit}", f"never in {never} of {len(found)} motions", False)
