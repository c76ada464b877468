"""`us-sim evaluate tissue`: errors against run time, on every mesh."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from us_sim.evaluation.block import MESHES
from us_sim.evaluation.figures import draw_lines
from us_sim.evaluation.subject import Report, Subject
from us_sim.evaluation.tissue.cases import MAIN_SCENE, SCENES
from us_sim.evaluation.tissue.measure import plan_pieces
from us_sim.evaluation.tissue_methods import LOOKS

_NODES = int(np.prod(MESHES[-1]))  # of the paper's finest mesh, on which results are shown
_AT_FRAME_RATE = {"30 frames a second": 1000.0 / 30.0}  # ms
_LABELS = {
    "ms_median": "ms a frame (median)",
    "rel_l2_error": "relative L2 error of the nodes",
}


def report_tissue(references: pd.DataFrame, points: pd.DataFrame) -> Report:
    """Report the methods' errors and run times."""
    points = points.assign(
        line=points["method"] + points["setting"].map({"stiffness=fitted": ", fitted"}).fillna(""),
        default=points["setting"] == "default",
    )
    shown = points[points["nodes"] == _NODES]
    main = points[points["scene"] == MAIN_SCENE]
    defaults = points[points["default"]]
    fronts = {scene: _find_pareto_front(some) for scene, some in shown.groupby("scene", sort=False)}
    places = {
        "change": f"{100 * references['l2_change'].max():.2g} %",
        "nodes": f"{_NODES:,}",
        "error": _draw_errors(shown, "scene", "to large deformation on fine elements"),
        "defaults": _tabulate_errors(shown[shown["default"]]),
        "meshes": _draw_errors(main, "nodes", f"by nodes of the mesh, {SCENES[MAIN_SCENE].words}"),
        "estimates": _tabulate_estimates(defaults),
    }
    return Report(list(_list_take_home(main, fronts)), places)


def _list_take_home(main: pd.DataFrame, fronts: dict[str, pd.DataFrame]) -> Iterator[str]:
    for p in main[main["default"] & (main["nodes"] == _NODES)].itertuples():
        yield (
            f"`{p.method}` is {100 * p.rel_l2_error:.2g} % off the reference "
            f"({SCENES[MAIN_SCENE].words}, {_NODES:,} nodes), in {p.ms_median:.3g} ms a frame."
        )
    ahead = [f"`{name}`" for name in dict.fromkeys(pd.concat(fronts.values())["method"])]
    yield f"In some scene the best error for its run time: {', '.join(ahead)}."


def _find_pareto_front(points: pd.DataFrame) -> pd.DataFrame:
    """Find the points than which no other is faster and more accurate, fastest first."""
    ordered = points.sort_values(["ms_median", "rel_l2_error"])
    best = ordered["rel_l2_error"].cummin().shift(fill_value=np.inf)
    return ordered[ordered["rel_l2_error"] < best]


def _draw_errors(points: pd.DataFrame, panels: str, words: str) -> Figure:
    """Draw errors over run time; full marks are defaults, a line joins equal equations."""
    looks = {
        line: replace(LOOKS[method], style="-" if line == method else "--")
        for method, line in zip(points["method"], points["line"], strict=True)
    }
    return draw_lines(
        *(points, "ms_median", "rel_l2_error", f"Error against run time, {words}"),
        panels=panels,
        lines="line",
        looks=looks,
        labels=_LABELS,
        filled="default",
        log="xy",
        limits=_AT_FRAME_RATE,
    )


def _tabulate_errors(points: pd.DataFrame) -> pd.DataFrame:
    """Tabulate the main columns, with names for a reader."""
    table = points[["scene", "method"]].copy()
    table["ms"], table["L2 %"] = points["ms_median"], 100 * points["rel_l2_error"]
    table["force %"] = 100 * points["force_error"]
    table["smallest volume ratio"] = points["smallest_volume_ratio"]
    return table


def _tabulate_estimates(defaults: pd.DataFrame) -> pd.DataFrame:
    """Tabulate the errors that methods estimate beside the true ones."""
    found = defaults[defaults["estimated_error"].notna()]
    table = found[["scene", "method", "nodes"]].copy()
    table["L2 %"] = 100 * found["rel_l2_error"]
    table["estimated %"] = 100 * found["estimated_error"].astype(float)
    table["ratio"] = table["estimated %"] / table["L2 %"]
    return table


TISSUE = Subject(
    "tissue",
    "Tissue: error against run time",
    plan_pieces,
    report_tissue,
    hidden=("smallest_volume_ratio",),
    libraries=("scikit-fem",),
)
