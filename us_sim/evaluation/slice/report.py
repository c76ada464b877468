"""`us-sim evaluate slice`: error of every slicing method against its run time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from us_sim.evaluation.figures import draw_error_over_time, draw_lines
from us_sim.evaluation.report import exponent
from us_sim.evaluation.slice.cases import MAIN, PLANES, cases
from us_sim.evaluation.slice.measure import OURS, case_rows
from us_sim.evaluation.subject import Piece, Report, Subject, Target

_FRAME = {"16.7 ms: 60 images a second": 1000.0 / 60.0}


def _pieces(quick: bool) -> Mapping[str, Sequence[Piece]]:
    return {
        "slice": [
            Piece(
                {
                    "method": "every method",
                    "size": case.size,
                    "nodes": int(np.prod(case.counts)),
                    "deformation": case.deformation,
                    "plane": case.plane,
                },
                partial(case_rows, case, _seconds(quick, case)),
            )
            for case in cases(quick)
        ]
    }


def _seconds(quick: bool, case: Any) -> float:
    """s, of timing the main case, and another."""
    main, other = (5.0, 1.0) if quick else (12.0, 2.0)
    return main if case == MAIN else other


def _report(table: pd.DataFrame) -> Report:
    table = table.assign(pixels=table["size"] ** 2)
    nodes = int(np.prod(MAIN.counts))
    image = table[(table["deformation"] == MAIN.deformation) & (table["plane"] == MAIN.plane)]
    meshes, sizes = image[image["size"] == MAIN.size], image[image["nodes"] == nodes]
    main = meshes[meshes["nodes"] == nodes]
    one = {name: rows[rows["threads"] == 1] for name, rows in main.groupby("method")}

    def ratio(slow: str) -> float:
        """The lesser of the ratios of wall clock and of processor time, on one thread."""
        if not {slow, OURS} <= one.keys():
            return np.nan
        times = ["ms_median", "cpu_ms_median"]
        return float((one[slow][times].iloc[0] / one[OURS][times].iloc[0]).min())

    own = table[table["method"] == OURS]
    wall = main[main["method"] == OURS].set_index("threads")["ms_median"]
    single = own[own["threads"] == 1]
    mine = {"meshes": meshes, "sizes": sizes}
    mine = {k: t[(t["method"] == OURS) & (t["threads"] == 1)] for k, t in mine.items()}
    by_nodes = mine["meshes"].set_index("nodes")["cpu_ms_median"].sort_index()
    by_pixels = mine["sizes"].set_index("pixels")["cpu_ms_median"]
    what = f"{MAIN.size} × {MAIN.size} on {main['tets'].max():,} tetrahedra pressed 12 mm"
    wrong, pixels = int(single["coverage_mismatch_px"].sum()), int(single["pixels"].sum())
    # A measured exponent of 1.004 is linear, too.
    power = round(exponent(by_pixels.to_dict()), 2)
    targets = [
        Target.at_most(f"{what}, one core", 2.0, wall.get(1, np.nan), "ms"),
        Target.at_most(f"{what}, two cores", 1.2, wall.get(2, np.nan), "ms"),
        Target.at_least("times as fast as VTK (filter and sampling)", 20, ratio("vtk")),
        Target.at_most(f"pixels of {pixels:,} with a wrong coverage", 0, wrong),
        Target.at_most("grey levels that a pixel is off", 1, own["max_grey_difference"].max()),
        Target.at_most(
            "time on 65,536 nodes over that on 2,000", 1.5, by_nodes.iloc[-1] / by_nodes.iloc[0]
        ),
        Target.at_most("k in time ~ pixels^k", 1, power),
    ]
    places: dict[str, Any] = {
        "table": _summed(main, table),
        "error": draw_error_over_time(
            sizes.assign(
                ms=np.where(sizes["threads"] == 1, sizes["cpu_ms_median"], sizes["ms_median"]),
                panel=sizes["size"].map("{0} × {0}".format),
                single=sizes["threads"] == 1,
            ),
            "ms",
            "max_voxel_error",
            "Error against run time (full: one thread, processor time; hollow: two, wall clock)",
            panels="panel",
            lines="method",
            filled="single",
            floor=1e-14,
            limits={**_FRAME, "y:a tenth of a voxel": 0.1},
            labels={"ms": "ms an image (median)", "max_voxel_error": "worst pixel, voxels at rest"},
        ),
        "pixels": _draw_times(sizes, "pixels"),
        "meshes": _draw_times(meshes, "nodes"),
        "planes": "; ".join(f"`{name}`: {view.words}" for name, view in PLANES.items()),
        "by_case": _across(
            table[(table["nodes"] == nodes) & (table["size"] == MAIN.size)], "deformation", "plane"
        ),
    }
    take_home = [
        f"An image of {what} takes {wall.get(1, np.nan):.2g} ms of one core, "
        f"{ratio('vtk'):.3g} times less than VTK's filters.",
        f"Every pixel shows the right tissue: {wrong} of {pixels:,} have a wrong coverage, and the "
        f"worst is {own['max_voxel_error'].max():.1g} voxels off its true place.",
        f"From 2,000 to 65,536 nodes the time grows {by_nodes.iloc[-1] / by_nodes.iloc[0]:.2g} "
        f"times; with the pixels as their power {power:g}.",
    ]
    return Report(take_home, places, targets)


def _summed(main: pd.DataFrame, table: pd.DataFrame) -> pd.DataFrame:
    """Every method in the main case, and its worst in all of them."""
    worst = table.groupby(["method", "threads"], sort=False).agg(
        **{
            "wrong px": ("coverage_mismatch_px", "sum"),
            "max grey": ("max_grey_difference", "max"),
            "mean grey": ("mean_grey_difference", "max"),
            "max voxel": ("max_voxel_error", "max"),
        }
    )
    times = main[["method", "threads", "ms_median", "ms_p99", "cpu_ms_median"]]
    return times.join(worst, on=["method", "threads"])


def _across(rows: pd.DataFrame, *columns: str) -> pd.DataFrame:
    """Processor times (ms) and wrong pixels of every method on one thread, along columns."""
    one = rows[rows["threads"] == 1]
    values = {"CPU ms": "cpu_ms_median", "wrong px": "coverage_mismatch_px"}
    wide = one.pivot_table(list(values.values()), list(columns), "method", sort=False)
    words = {column: name for name, column in values.items()}
    wide.columns = pd.Index([f"{method}, {words[value]}" for value, method in wide.columns])
    return wide.reset_index()


def _draw_times(rows: pd.DataFrame, across: str) -> Figure:
    return draw_lines(
        rows[rows["threads"] == 1],
        across,
        "cpu_ms_median",
        f"Time against {across}, pressed by 12 mm",
        lines="method",
        log="xy",
        limits={"y:16.7 ms: 60 images a second": 1000.0 / 60.0},
        labels={"cpu_ms_median": "processor time of an image, ms (median, one thread)"},
    )


SLICE = Subject(
    "slice",
    "Slices: error against run time",
    _pieces,
    _report,
    libraries=("numpy", "scipy", "numba", "vtk"),
)
