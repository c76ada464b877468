"""What is asked of the viewer, against what was seen in one run."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from us_sim.evaluation.target import Target
from us_sim.evaluation.viewer.points import Point


def targets(points: Sequence[Point]) -> list[Target]:
    """Every measure that is asked for."""
    by_name: dict[str, Point] = {}
    for point in points:  # of two of one name the longer one, which comes last
        by_name[point.title] = point

    def seen(name: str, value: Callable[[Point], float]) -> float:
        point = by_name.get(name)
        return np.nan if point is None or point.failure else float(value(point))

    without = seen("no viewer, path", lambda p: p.made)
    taking = seen("1 page that takes, path", lambda p: p.made)
    browser, hand = "1 browser, path", "1 browser, hand"
    taker = "1 page that takes, hand"
    return [
        Target.at_least("images a second in a browser, path", 25, seen(browser, lambda p: p.shown)),
        Target.at_least("images a second in a browser, hand", 25, seen(hand, lambda p: p.shown)),
        Target.at_most(
            "browser: ms from the mouse to the image, median",
            *(60, seen(hand, lambda p: p.delay_median), "ms"),
        ),
        Target.at_most(
            "browser: ms from the mouse to the image, 99th percentile",
            *(120, seen(hand, lambda p: p.delay_p99), "ms"),
        ),
        Target.at_most(
            "page that takes: ms from a command to its image, median",
            *(60, seen(taker, lambda p: p.delay_median), "ms"),
        ),
        Target.at_most(
            "page that takes: ms from a command to its image, 99th percentile",
            *(120, seen(taker, lambda p: p.delay_p99), "ms"),
        ),
        Target.at_most(
            "images a second that the simulator loses to a page that takes",
            *(10, 100.0 * (1.0 - taking / without), "%"),
        ),
        Target.at_most(
            "from `us-sim view` to the first image in a page",
            *(4, seen(taker, lambda p: p.started), "s"),
        ),
        Target.under(
            "growth of the viewer after the first minute",
            *(1, seen(browser, lambda p: p.growth("viewer")), "MB/min"),
        ),
        Target.under(
            "growth of the browser after the first minute",
            *(1, seen(browser, lambda p: p.growth("browser")), "MB/min"),
        ),
    ]
