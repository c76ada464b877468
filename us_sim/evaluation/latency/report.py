"""`us-sim evaluate latency`: how old a pose is when its image comes, hop by hop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
import pandas as pd

from us_sim.evaluation.figures import draw_lines
from us_sim.evaluation.latency.measure import BUSY, DEMO, Case, cases, run_case
from us_sim.evaluation.subject import Piece, Report, Subject, Target
from us_sim.run.processes import prepare_ros

_SHOWN = {
    "case": "",
    "scheduling": "scheduling",
    "images_a_second": "images/s",
    "dropped": "dropped",
    "probe_pose_ms_p50": "pose ms p50",
    "tissue_nodes_ms_p50": "nodes ms p50",
    "tissue_nodes_ms_p99": "nodes p99",
    "ultrasound_image_ms_p50": "image ms p50",
    "ultrasound_image_ms_p99": "image p99",
    "ultrasound_image_ms_worst": "image worst",
    "image_mm_p50": "mm p50",
    "image_mm_p99": "mm p99",
    "cores_all": "cores",
    "memory_mb_all": "MB",
    "not_recorded": "not recorded",
}


def _pieces(quick: bool) -> Mapping[str, Sequence[Piece]]:
    prepare_ros(network=False)
    return {"latency": [Piece(case.columns, partial(run_case, case)) for case in cases(quick)]}


def _report(table: pd.DataFrame) -> Report:
    def seen(case: Case, column: str) -> float:
        """The value of a case, however long it was."""
        rows = table[table["case"] == str(case)]
        return float(rows[column].iloc[0]) if len(rows) else np.nan

    age, worst = "ultrasound_image_ms_p50", "ultrasound_image_ms_p99"
    name, busy = "demo", "demo, cores busy"
    targets = [
        Target.at_most(f"{name}: ms from a pose to its image, median", 12, seen(DEMO, age), "ms"),
        Target.at_most(f"{name}: likewise, 99th percentile", 25, seen(DEMO, worst), "ms"),
        Target.at_least(f"{name}: images a second", 59, seen(DEMO, "images_a_second")),
        Target.at_most(f"{name}: images not recorded", 0, seen(DEMO, "not_recorded")),
        Target.at_most(
            f"{name}: growth of the fastest growing process after the first minute",
            1,
            seen(DEMO, "growth_mb_a_minute"),
            "MB/min",
        ),
        Target.at_least(f"{busy}: images a second", 50, seen(BUSY, "images_a_second")),
        Target.at_most(f"{busy}: ms to an image, 99th percentile", 50, seen(BUSY, worst), "ms"),
    ]
    longest = table.loc[table["seconds"].idxmax()]
    hops = [f"{name}_ms_p50" for name in ("probe_pose", "tissue_nodes", "ultrasound_image")]
    pose, nodes, image = (seen(DEMO, hop) for hop in hops)
    take_home = [
        f"With `fem` an image is {seen(Case(), age):.3g} ms old when it comes, "
        f"{seen(Case(), worst):.3g} ms at the 99th percentile, at "
        f"{seen(Case(), 'images_a_second'):.3g} images a second of 60 poses.",
        f"`fem_nonlinear`, as in the demo: {image:.3g} and {seen(DEMO, worst):.3g} ms; of these "
        f"{pose:.2g} ms to the filtered pose, {nodes - pose:.2g} to the tissue and "
        f"{image - nodes:.2g} from there to the image.",
        f"A hand at 100 mm/s is {seen(DEMO, 'image_mm_p50'):.2g} mm farther by then.",
        f"With every core busy with something else, nodes that go first give "
        f"{seen(BUSY, 'images_a_second'):.3g} images a second, {seen(BUSY, worst):.3g} ms at p99.",
    ]
    places = {
        "rows": table[list(_SHOWN)].rename(columns=_SHOWN),
        "cores": table[["case", *(name for name in table if name.startswith("cores_"))]]
        .drop(columns=["cores_busy"])
        .rename(columns=lambda name: name.removeprefix("cores_")),
        "longest": str(longest["case"]),
        "time": draw_lines(
            pd.DataFrame(longest["ages"]),
            "s",
            "ms",
            f"Age of every image: {longest['case']}",
            join=False,
            labels={"s": "time, s", "ms": "ms from a pose to its image"},
        ),
    }
    return Report(take_home, places, targets)


LATENCY = Subject(
    "latency",
    "Latency: from the tracker's pose to its image",
    _pieces,
    _report,
    hidden=("case", "ages"),
    libraries=("numpy", "numba"),
)
