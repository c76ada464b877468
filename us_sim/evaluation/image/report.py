"""`us-sim evaluate image`: sound in images, against closed forms, and what it costs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import pandas as pd

from us_sim.evaluation.figures import draw_image_grid
from us_sim.evaluation.image.acoustics import STATES, measure_attenuation, measure_shadows
from us_sim.evaluation.image.measure import make_arm_images, measure_run_times
from us_sim.evaluation.subject import Piece, Report, Subject, Target

ARTEFACTS: Mapping[str, Callable[[bool], Iterable[Mapping[str, Any]]]] = {
    "attenuation": measure_attenuation,
    "shadow_edge": measure_shadows,
    "run_time": measure_run_times,
}


def _plan_pieces(quick: bool) -> Mapping[str, Sequence[Piece]]:
    return {
        "image": [
            Piece({"artefact": name}, partial(rows, quick)) for name, rows in ARTEFACTS.items()
        ]
    }


def report_image(table: pd.DataFrame) -> Report:
    """Report the errors and run times of the table; a failed piece has none."""
    table = table.assign(off=(table["measured"] - table["expected"]).abs())

    def find_worst(artefact: str, column: str) -> float:
        rows = table[table["artefact"].str.startswith(artefact)]
        return float(rows[column].abs().max())

    loss = find_worst("attenuation", "error_percent")
    ms = {kind: find_worst(f"run_time_{kind}", "measured") for kind in ("slice", "strain", "all")}
    limits: Sequence[tuple[str, float, float, str]] = (
        ("loss in layers, tilted up to 40°: amplitude, worst depth", 1.0, loss, "%"),
        *(
            (
                f"shadow of bone, {state}: pixels from its geometric edge, worst",
                1.0,
                find_worst(f"shadow_edge_{state}", "off"),
                "",
            )
            for state in STATES
        ),
        ("image of 512 × 512 with all acoustics, one core", 1.5, ms["all"], "ms"),
        ("times the time of the slice", 1.67, ms["all"] / ms["slice"], ""),
        ("strain, likewise", 2.22, ms["strain"] / ms["slice"], ""),
    )
    take_home = [
        f"Loss through layers is {loss:.2g} % off in amplitude at worst.",
        f"A shadow's edge is {find_worst('shadow_edge', 'off'):.2g} pixels off, at rest and "
        f"pressed.",
        f"An image of 512 × 512 takes {ms['slice']:.2f} ms of a core, with strain "
        f"{ms['strain']:.2f} ms, with all acoustics {ms['all']:.2f} ms.",
    ]
    timed = table[table["unit"] == "ms"]
    closed = table[table["unit"] != "ms"]
    places = {
        "arm_tilts": draw_image_grid(make_arm_images(), "The arm at five tilts"),
        "errors": closed.pivot_table("off", ["artefact", "unit"], "probe", "max", sort=False)
        .reset_index()
        .rename_axis(columns=None),
        "run_time": pd.DataFrame(
            {
                "with": timed["artefact"].str.removeprefix("run_time_").str.replace("_", " "),
                "ms": timed["measured"],
                "times the slice": timed["measured"] / ms["slice"],
            }
        ),
    }
    return Report(take_home, places, [Target.at_most(*limit) for limit in limits])


IMAGE = Subject(
    "image",
    "Image: sound against closed forms",
    _plan_pieces,
    report_image,
    libraries=("opencv-python-headless", "opencv-python"),
)
