"""`us-sim evaluate slice`: error of every slicing method against its run time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
import pandas as pd

from us_sim.evaluation.figures import draw_lines
from us_sim.evaluation.report import fit_exponent
from us_sim.evaluation.slice.cases import MAIN, PLANES, list_cases
from us_sim.evaluation.slice.measure import OURS, measure_case
from us_sim.evaluation.subject import Piece, Report, Subject, Target


def _plan_pieces(quick: bool) -> Mapping[str, Sequence[Piece]]:
    main, other = (5.0, 1.0) if quick else (12.0, 2.0)  # s of timing
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
                partial(measure_case, case, main if case == MAIN else other),
            )
            for case in list_cases(quick)
        ]
    }


def _report(table: pd.DataFrame) -> Report:
    nodes = int(np.prod(MAIN.counts))
    image = table[(table["deformation"] == MAIN.deformation) & (table["plane"] == MAIN.plane)]
    meshes, sizes = image[image["size"] == MAIN.size], image[image["nodes"] == nodes]
    main = meshes[meshes["nodes"] == nodes]
    ours = table[table["method"] == OURS]
    single = ours[ours["threads"] == 1]
    one = main[main["threads"] == 1].set_index("method")[["ms_median", "cpu_ms_median"]]
    # The lesser of the ratios of wall clock and of processor time.
    faster = float((one.loc["vtk"] / one.loc[OURS]).min()) if "vtk" in one.index else np.nan
    wall = main[main["method"] == OURS].set_index("threads")["ms_median"]
    by_nodes, by_pixels = (
        rows.loc[rows.index.intersection(single.index)].set_index(column)["cpu_ms_median"]
        for rows, column in ((meshes, "nodes"), (sizes, "size"))
    )
    growth = float(by_nodes.sort_index().iloc[-1] / by_nodes.sort_index().iloc[0])
    # A measured exponent of 1.004 is linear, too.
    power = round(fit_exponent(by_pixels.to_dict()) / 2.0, 2)
    what = f"{MAIN.size} × {MAIN.size} on {main['tets'].max():,} tetrahedra pressed 12 mm"
    wrong, pixels = int(single["coverage_mismatch_px"].sum()), int((single["size"] ** 2).sum())
    targets = [
        Target.at_most(f"{what}, one core", 2.0, wall.get(1, np.nan), "ms"),
        Target.at_most(f"{what}, two cores", 1.2, wall.get(2, np.nan), "ms"),
        Target.at_least("times as fast as VTK (filter and sampling)", 20, faster),
        Target.at_most(f"pixels of {pixels:,} with a wrong coverage", 0, wrong),
        Target.at_most("grey levels that a pixel is off", 1, ours["max_grey_difference"].max()),
        Target.at_most("time on 65,536 nodes over that on 2,000", 1.5, growth),
        Target.at_most("k in time ~ pixels^k", 1, power),
    ]
    by_size = sizes.assign(across="pixels", count=sizes["size"] ** 2)
    counted = pd.concat([by_size, meshes.assign(across="nodes", count=meshes["nodes"])])
    errors = ["coverage_mismatch_px", "max_grey_difference", "max_voxel_error"]
    worst = table.groupby(["method", "threads"], sort=False)[errors].max()
    places = {
        "table": main[["method", "threads", "ms_median", "ms_p99", "cpu_ms_median"]].join(
            worst, on=["method", "threads"]
        ),
        "error": draw_lines(
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
            log="xy",
            floor=1e-14,
            limits={"16.7 ms: 60 images a second": 1000.0 / 60.0, "y:a tenth of a voxel": 0.1},
            labels={"ms": "ms an image (median)", "max_voxel_error": "worst pixel, voxels at rest"},
        ),
        "sizes": draw_lines(
            counted[counted["threads"] == 1],
            "count",
            "cpu_ms_median",
            "Time against pixels and nodes, pressed by 12 mm",
            panels="across",
            lines="method",
            log="xy",
            limits={"y:16.7 ms: 60 images a second": 1000.0 / 60.0},
            labels={"count": "", "cpu_ms_median": "processor time of an image, ms (one thread)"},
        ),
        "planes": "; ".join(f"`{name}`: {view.words}" for name, view in PLANES.items()),
    }
    take_home = [
        f"An image of {what} takes {wall.get(1, np.nan):.2g} ms of one core, {faster:.3g} times "
        f"less than VTK's filters.",
        f"Every pixel shows the right tissue: {wrong} of {pixels:,} have a wrong coverage, and the "
        f"worst is {ours['max_voxel_error'].max():.1g} voxels off its true place.",
        f"From 2,000 to 65,536 nodes the time grows {growth:.2g} times; it grows with the "
        f"pixels to the power {power:g}.",
    ]
    return Report(take_home, places, targets)


SLICE = Subject(
    "slice",
    "Slices: error against run time",
    _plan_pieces,
    _report,
    libraries=("vtk",),
)
