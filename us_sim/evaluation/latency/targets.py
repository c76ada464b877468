"""What is asked of a live simulation, against what was seen in one run."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from us_sim.evaluation.latency.cases import DEMO, LIVE, Case
from us_sim.evaluation.latency.points import Point
from us_sim.evaluation.target import Target

_IMAGE = "ultrasound/image"


def targets(points: Sequence[Point]) -> list[Target]:
    """Every measure that is asked for."""
    live, demo = _alike(points, LIVE, busy=False), _alike(points, DEMO, busy=True)
    name, busy = str(LIVE), "demo's method, cores busy"
    return [
        Target.at_most(f"{name}: poses without an image", 0, _seen(live, lambda p: p.dropped)),
        *_ages(name, live, 12, 25),
        Target.at_most(f"{name}: images not recorded", 0, _seen(live, lambda p: p.lost)),
        Target.under(
            f"{name}: growth of the fastest growing process after the first minute",
            *(1, _seen(live, lambda p: p.growth), "MB/min"),
        ),
        Target.at_least(f"{busy}: images a second", 50, _seen(demo, lambda p: p.rate)),
        _ages(busy, demo, np.nan, 50)[1],
    ]


def _ages(name: str, point: Point | None, median: float, most: float) -> list[Target]:
    what = f"{name}: ms from a pose to its image"
    return [
        Target.at_most(f"{what}, {words}", limit, _age(point, percent), "ms")
        for words, limit, percent in (("median", median, 50), ("99th percentile", most, 99))
    ]


def _age(point: Point | None, percent: float) -> float:
    return _seen(point, lambda p: p.latency(_IMAGE, percent))


def _seen(point: Point | None, value: Callable[[Point], float]) -> float:
    return np.nan if point is None or not point.images else float(value(point))


def _alike(points: Sequence[Point], wanted: Case, *, busy: bool) -> Point | None:
    """The point of the wanted case, however long it was."""
    same = (wanted.solver, wanted.mesh, wanted.image, wanted.placed, True, False, busy, True)
    for point in points:
        case = point.case
        if same == (
            *(case.solver, case.mesh, case.image, case.placed),
            *(case.recorder, case.viewer, case.busy, case.realtime),
        ):
            return point
    return None
