"""`us-sim evaluate viewer`: cost of a page to the simulator, and its delay of images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import pandas as pd

from us_sim.evaluation.report import read_case
from us_sim.evaluation.subject import Piece, Report, Subject, Target
from us_sim.evaluation.viewer.measure import list_cases, run_case
from us_sim.run.processes import prepare_ros


def _plan_pieces(quick: bool) -> Mapping[str, Sequence[Piece]]:
    prepare_ros(network=False)
    return {
        "viewer": [
            Piece({"case": str(case), "seconds": case.seconds}, partial(run_case, case))
            for case in list_cases(quick)
        ]
    }


def report_viewer(table: pd.DataFrame) -> Report:
    """Report the rates, delays and costs of the page."""
    get_value = partial(read_case, table)
    browser, hand = "1 browser, path", "1 browser, hand"
    shown = "images_a_second_shown"
    mouse = [get_value(hand, f"delay_ms_{part}") for part in ("median", "p99")]
    without = get_value("no viewer, path", "images_a_second_made")
    lost = 100.0 * (1.0 - get_value(browser, "images_a_second_made") / without)
    targets = [
        Target.at_least("images a second in a browser, path", 25, get_value(browser, shown)),
        Target.at_least("images a second in a browser, hand", 25, get_value(hand, shown)),
        Target.at_most("browser: ms from the mouse to the image, median", 60, mouse[0], "ms"),
        Target.at_most("browser: likewise, 99th percentile", 120, mouse[1], "ms"),
        Target.at_most("images a second that the simulator loses to a page", 10, lost, "%"),
        Target.at_most("s from opening a page to its image", 4, get_value(hand, "page_opened_s")),
        *(
            Target.at_most(
                f"growth of the {name} after the first minute",
                1,
                get_value(browser, f"growth_mb_a_minute_{name}"),
                "MB/min",
            )
            for name in ("viewer", "browser")
        ),
    ]
    take_home = [
        f"The page in a browser shows {get_value(browser, shown):.3g} images a second of a path, "
        f"{get_value(hand, shown):.3g} while the mouse drags the probe.",
        f"From the mouse to the image it takes {mouse[0]:.3g} ms, {mouse[1]:.3g} at the 99th "
        f"percentile.",
        f"A page costs the simulator {lost:.2g} % of its images; the viewer keeps "
        f"{get_value(browser, 'cores_viewer'):.2g} cores busy, the browser "
        f"{get_value(browser, 'cores_browser'):.2g}.",
        f"From `us-sim view` to the first image it takes {get_value(hand, 'start_s'):.2g} s.",
    ]
    rows = table.filter(regex="^(case|s|images|poses|image_|delay_|start|page|cores|memory)")
    return Report(take_home, {"rows": rows}, targets)


VIEWER = Subject(
    "viewer",
    "The viewer: cost and delay",
    _plan_pieces,
    report_viewer,
    libraries=("nicegui", "playwright"),
)
