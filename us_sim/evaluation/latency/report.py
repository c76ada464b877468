"""`us-sim evaluate latency`: age of a pose when its image comes, hop by hop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial

import pandas as pd

from us_sim.evaluation.latency.measure import BUSY, DEMO, LatencyCase, list_cases, run_case
from us_sim.evaluation.report import read_case
from us_sim.evaluation.subject import Piece, Report, Subject, Target
from us_sim.run.processes import prepare_ros


def _plan_pieces(quick: bool) -> Mapping[str, Sequence[Piece]]:
    prepare_ros(network=False)
    return {
        "latency": [
            Piece({"case": str(case), **asdict(case)}, partial(run_case, case))
            for case in list_cases(quick)
        ]
    }


def _report(table: pd.DataFrame) -> Report:
    get_value = partial(read_case, table)
    age, worst = "ultrasound_image_ms_p50", "ultrasound_image_ms_p99"
    growth, lost = get_value(DEMO, "growth_mb_a_minute"), get_value(DEMO, "not_recorded")
    targets = [
        Target.at_most("demo: ms from a pose to its image, median", 12, get_value(DEMO, age), "ms"),
        Target.at_most("demo: likewise, 99th percentile", 25, get_value(DEMO, worst), "ms"),
        Target.at_least("demo: images a second", 59, get_value(DEMO, "images_a_second")),
        Target.at_most("demo: images not recorded", 0, lost),
        Target.at_most("demo: growth of the fastest growing process", 1, growth, "MB/min"),
        Target.at_least(
            "demo, cores busy: images a second", 50, get_value(BUSY, "images_a_second")
        ),
        Target.at_most(
            "demo, cores busy: ms to an image, 99th percentile", 50, get_value(BUSY, worst), "ms"
        ),
    ]
    hops = [f"{name}_ms_p50" for name in ("probe_pose", "tissue_nodes", "ultrasound_image")]
    pose, nodes, image = (get_value(DEMO, hop) for hop in hops)
    take_home = [
        f"With `fem` an image is {get_value(LatencyCase(), age):.3g} ms old when it comes, "
        f"{get_value(LatencyCase(), worst):.3g} ms at the 99th percentile, at "
        f"{get_value(LatencyCase(), 'images_a_second'):.3g} images a second of 60 poses.",
        f"`fem_nonlinear`, as in the demo: {image:.3g} and {get_value(DEMO, worst):.3g} ms; of "
        f"these {pose:.2g} ms to the filtered pose, {nodes - pose:.2g} to the tissue and "
        f"{image - nodes:.2g} from there to the image.",
        f"In that time, a hand at 100 mm/s moves by {get_value(DEMO, 'image_mm_p50'):.2g} mm.",
        f"With all cores busy with other programs, nodes with priority give "
        f"{get_value(BUSY, 'images_a_second'):.3g} images a second, "
        f"{get_value(BUSY, worst):.3g} ms old at p99.",
    ]
    places = {
        "rows": table.filter(
            regex="^(case|images_a|not_rec|(probe|tissue|ultra).*_ms_p50|.*_image_ms_p99|cores_all|memory)"
        ),
    }
    return Report(take_home, places, targets)


LATENCY = Subject(
    "latency",
    "Latency: from the tracker's pose to its image",
    _plan_pieces,
    _report,
    hidden=("case",),
)
