"""What is asked of tracking, against what was seen in one run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from us_sim.evaluation.target import Target
from us_sim.evaluation.tracking.cases import LARGE, RIGID_BODY, SINGLE, SMALL
from us_sim.evaluation.tracking.points import Point, View

__all__ = ["body_views", "single_views", "targets"]

_VISIBLE = 4  # markers


def targets(points: Sequence[Point]) -> list[Target]:
    """Every measure that is asked for."""
    body = [view for view in body_views(points) if view.visible == _VISIBLE]
    single = single_views(points)
    found = [view for view in single if view.detected]
    tracked = sum(view.detected for view in body)
    where = f"{_VISIBLE} visible 30 mm markers at 0.4 m, 640 × 480"
    return [
        Target.at_most(
            "ms an image of 640 × 480 on one core, body of 6 markers", 8, _ms(points, SMALL)
        ),
        Target.at_most("ms an image of 1920 × 1080 on one core", 20, _ms(points, LARGE)),
        Target(
            f"{where}: tracked of {len(body)} views",
            "all",
            f"{tracked}",
            tracked == len(body) if body else None,
        ),
        Target.at_most(f"{where}: mm, median", 0.3, _percentile(body, "mm", 50)),
        Target.at_most(f"{where}: mm, 95th percentile", 1.0, _percentile(body, "mm", 95)),
        Target.at_most(f"{where}: degrees, median", 0.2, _percentile(body, "degrees", 50)),
        Target.at_most(f"{where}: degrees, 95th percentile", 0.6, _percentile(body, "degrees", 95)),
        Target.at_most(
            f"{where}: flips", 0, sum(view.flipped for view in body) if body else np.nan
        ),
        Target.under(
            f"single 40 mm marker in plain views ({len(found)} of {len(single)} found): % flipped",
            0.5,
            100 * sum(view.flipped for view in found) / len(found) if found else np.nan,
        ),
    ]


def body_views(points: Sequence[Point]) -> list[View]:
    """Plain views of the rigid body at 0.4 m in small images."""
    return [
        view
        for point in points
        for view in point.views
        if point.case.marker == RIGID_BODY
        and point.case.condition == "plain"
        and point.case.distance == 0.4
        and point.case.image_size == SMALL
    ]


def single_views(points: Sequence[Point]) -> list[View]:
    """Plain views of the single marker from everywhere, in small images and large ones."""
    return [
        view
        for point in points
        for view in point.views
        if point.case.marker == SINGLE and point.case.condition == "plain"
    ]


def _ms(points: Sequence[Point], image_size: str) -> float:
    """Median processor time of plain images of the rigid body from 0.4 m."""
    mine = [
        view.cpu_ms
        for point in points
        for view in point.views
        if point.case.marker == RIGID_BODY
        and point.case.image_size == image_size
        and (point.case.condition, point.case.distance) == ("plain", 0.4)
    ]
    return float(np.median(mine)) if mine else float("nan")


def _percentile(views: Sequence[View], name: str, percent: float) -> float:
    values = [getattr(view, name) for view in views if view.detected]
    return float(np.percentile(values, percent)) if values else float("nan")
