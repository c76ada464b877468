"""`us-sim evaluate measured`: the simulator against measurements of others."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
from threadpoolctl import threadpool_limits

from us_sim.errors import UsSimError
from us_sim.evaluation.measured.hydrogel import plan_hydrogel, report_hydrogel
from us_sim.evaluation.measured.silicone import plan_silicone, report_silicone
from us_sim.evaluation.measured.vein import plan_vein, report_vein
from us_sim.evaluation.settings import MeasuredData
from us_sim.evaluation.subject import Piece, Place, Report, Subject

COLUMNS = ("case", "quantity", "unit", "measured", "predicted", "error", "floor", "fitted_on")
"""Columns besides ``study``; unknown values are empty."""


@dataclass(frozen=True)
class Study:
    """One comparison with data that others measured."""

    folder: str  # below the folder of all data; empty where the study needs none
    plan: Callable[[Path, bool], Sequence[Piece]]  # of that folder, and True for a quick run
    report: Callable[[pd.DataFrame], tuple[str, Mapping[str, Place]]]
    """From the study's rows: the line to take home, and the contents of the page's places."""


STUDIES = {
    "hydrogel": Study("hydrogel-indentation", plan_hydrogel, report_hydrogel),
    "silicone": Study("ecoflex-compression", plan_silicone, report_silicone),
    "vein": Study("", plan_vein, report_vein),
}


def plan_pieces(quick: bool, settings: MeasuredData | None = None) -> dict[str, list[Piece]]:
    """List the pieces of the studies whose data are there.

    Raises:
        UsSimError: a folder of all data is named, and has none of them.
    """
    environment = os.environ.get("US_SIM_TEST_DATA")
    data = settings.data if settings and settings.data else environment and Path(environment)
    needed = [study.folder for study in STUDIES.values() if study.folder]
    if data and not any((data / name).is_dir() for name in needed):
        raise UsSimError(
            f"{data}: has no measured data: name with --data, or with US_SIM_TEST_DATA, the folder "
            f"that has one or more of these: {', '.join(needed)}"
        )
    folders = {name: Path(data or "") / study.folder for name, study in STUDIES.items()}
    return {
        "measured": [
            replace(piece, measure=partial(_measure, piece))
            for name, study in STUDIES.items()
            if not study.folder or (data and folders[name].is_dir())
            for piece in study.plan(folders[name], quick)
        ]
    }


def _measure(piece: Piece) -> Iterator[dict[str, Any]]:
    with threadpool_limits(1):  # as live
        for row in piece.measure():
            yield {name: row.get(name) for name in COLUMNS} | dict(row)


def report_measured(rows: pd.DataFrame) -> Report:
    """Report the findings of each study."""
    rows = rows.astype(dict.fromkeys(("measured", "predicted", "error", "floor"), float))
    places: dict[str, Place] = {}
    take_home = []
    for name, found in rows.groupby("study", sort=False):
        words, shown = STUDIES[name].report(found)
        take_home.append(words)
        places |= shown
    left_out = [name for name in STUDIES if name not in set(rows["study"])]
    if left_out:
        take_home.append(f"Left out, since the data are not there: {', '.join(left_out)}.")
    return Report(take_home, places)


MEASURED = Subject(
    "measured",
    "Measured: error against the real world",
    plan_pieces,
    report_measured,
    hidden=("panel", "line", "x", "curve"),
)
