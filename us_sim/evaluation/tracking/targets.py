"""What is asked of tracking, against what was seen in one run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from us_sim.evaluation.target import Target
from us_sim.evaluation.tracking.cases import LARGE, RIGID_BODY, SINGLE, SMALL
from us_sim.evaluation.tracking.points import Point, View, views_of
from us_sim.evaluation.tracking.small_markers import SmallMarkerPoint

_BODY = {"marker": RIGID_BODY, "condition": "plain", "distance": 0.4}

_VISIBLE = 4  # markers


def targets(points: Sequence[Point]) -> list[Target]:
    """Every measure that is asked for."""
    views = views_of(points, **_BODY, image_size=SMALL)
    body = [view for view in views if view.visible == _VISIBLE]
    single = views_of(points, marker=SINGLE, condition="plain")
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


def small_marker_targets(points: Sequence[SmallMarkerPoint]) -> list[Target]:
    """That no small marker is lost that OpenCV finds."""
    found, kept = (sum(getattr(p, name) for p in points) for name in ("found_by_opencv", "kept"))
    said = f"markers of 14 to 44 pixels: kept of {found} that OpenCV finds"
    return [Target(said, "all", f"{kept}", kept == found if found else None)]


def _ms(points: Sequence[Point], image_size: str) -> float:
    """Median processor time of plain images of the rigid body from 0.4 m."""
    mine = [view.cpu_ms for view in views_of(points, **_BODY, image_size=image_size)]
    return float(np.median(mine)) if mine else float("nan")


def _percentile(views: Sequence[View], name: str, percent: float) -> float:
    values = [getattr(view, name) for view in views if view.detected]
    return float(np.percentile(values, percent)) if values else float("nan")
