"""`us-sim evaluate tracking`: bodies of markers in rendered views."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from us_sim.evaluation.figures import draw_image_grid, draw_lines
from us_sim.evaluation.subject import Piece, Report, Subject, Target
from us_sim.evaluation.tracking.cases import (
    CONDITIONS,
    LARGE,
    MARKERS,
    RIGID_BODY,
    SINGLE,
    SMALL,
    TrackingCase,
    list_cases,
)
from us_sim.evaluation.tracking.measure import TrackingBench
from us_sim.tracking.camera.rendered_views import WEBCAMS, RenderedView

_QUICK_SEQUENCES = {SMALL: 5, LARGE: 3}  # sequences of views a case, by the size of the images
_SEQUENCES = {SMALL: 12, LARGE: 8}
_ERRORS = {"median_mm": "position, mm", "median_deg": "rotation, degrees"}


def _plan_pieces(quick: bool) -> Mapping[str, Sequence[Piece]]:
    tracking = TrackingBench()
    return {"tracking": [_plan_case(tracking, case, quick) for case in list_cases(quick)]}


def _plan_case(tracking: TrackingBench, case: TrackingCase, quick: bool) -> Piece:
    sequences = (_QUICK_SEQUENCES if quick else _SEQUENCES)[case.image_size]
    if case.condition == "plain" and case.marker in (SINGLE, RIGID_BODY):
        sequences *= 3  # the targets are about these
    columns = {
        "marker": case.marker,
        "image_size": case.image_size,
        "distance_m": case.distance,
        "angle_deg": case.angle,
        "condition": case.condition,
    }
    return Piece(columns, partial(tracking.measure_case, case, sequences))


def _report(table: pd.DataFrame) -> Report:
    case = ["marker", "image_size", "distance_m", "angle_deg", "condition"]
    shots = pd.concat(
        [row.shots.assign(**{n: row[n] for n in case}) for _, row in table.iterrows()]
    )
    plain = table[table["condition"] == "plain"]
    near = shots[(shots["distance_m"] == 0.4) & (shots["image_size"] == SMALL)]
    body = near[(near["marker"] == RIGID_BODY) & (near["condition"] == "plain")]
    body = body[body["visible"] == 4]
    single = shots[(shots["marker"] == SINGLE) & (shots["condition"] == "plain")]
    ms = shots[(shots["marker"] == RIGID_BODY) & (shots["distance_m"] == 0.4)]
    ms = ms[ms["condition"] == "plain"].groupby("image_size")["cpu_ms"].median()
    flips = 100 * single["flipped"].sum() / max(1, single["detected"].sum())
    where = "4 visible 30 mm markers at 0.4 m, 640 × 480"
    targets = [
        Target.at_most("ms an image of 640 × 480 on one core, body of 6 markers", 8, ms[SMALL]),
        Target.at_most("ms an image of 1920 × 1080 on one core", 20, ms.get(LARGE, np.nan)),
        Target.at_least(f"{where}: % tracked", 100, 100 * body["detected"].mean()),
        Target.at_most(f"{where}: mm, median", 0.3, body["mm"].median()),
        Target.at_most(f"{where}: mm, 95th percentile", 1.0, body["mm"].quantile(0.95)),
        Target.at_most(f"{where}: degrees, median", 0.2, body["degrees"].median()),
        Target.at_most(f"{where}: degrees, 95th percentile", 0.6, body["degrees"].quantile(0.95)),
        Target.at_most(f"{where}: flips", 0, body["flipped"].sum()),
        Target.at_most("single 40 mm marker in plain views: % flipped", 0.5, flips),
    ]
    hidden = near[(near["condition"] == "occlusion") & (near["marker"] == SINGLE)]
    take_home = [
        f"A body of six 30 mm markers at 0.4 m before a webcam is {body['mm'].median():.2g} mm and "
        f"{body['degrees'].median():.2g}° off (median), in {ms[SMALL]:.2g} ms of one core.",
        f"A single 40 mm marker flips to its mirror image in {flips:.2g} % of the views. A hand "
        f"over a third of it hides it in {100 * (1 - hidden['detected'].mean()):.0f} % of them; a "
        f"body of several markers is still tracked there.",
    ]
    places = {
        "count": f"{len(shots):,}",
        "markers": [f"`{name}`: {marker.words}" for name, marker in MARKERS.items()],
        "conditions_in_words": [f"{name}: {words}" for name, (_, words) in CONDITIONS.items()],
        "views": _draw_views(),
        "error": _draw_errors(
            plain[(plain["angle_deg"] == 30) & (plain["image_size"] == SMALL)],
            "distance_m",
            "Median error over the distance, at 30°, 640 × 480",
        ),
        "angle": _draw_errors(
            plain[(plain["distance_m"] == 0.4) & (plain["image_size"] == SMALL)],
            "angle_deg",
            "Median error over the angle, at 0.4 m, 640 × 480",
        ),
        "run_time": draw_lines(
            _melt_errors(plain[plain["distance_m"] == 0.4]),
            "cpu_ms_median",
            "error",
            "Median error over run time at 0.4 m (full: 640 × 480; hollow: 1920 × 1080)",
            panels="of",
            lines="marker",
            filled="small",
            log="xy",
            join=False,
            share_y=False,
            labels={"cpu_ms_median": "processor time of an image, ms (median)", "error": ""},
        ),
        "conditions": _tabulate_conditions(near[near["marker"].isin([SINGLE, RIGID_BODY])]),
    }
    return Report(take_home, places, targets)


def _tabulate_conditions(shots: pd.DataFrame) -> pd.DataFrame:
    """Tabulate the part of views in which each body is found, by condition, and the errors."""
    rows = [
        {
            "marker": marker,
            "condition": condition,
            "found, %": 100 * some["detected"].mean(),
            "mm": some["mm"].median(),
            "mm, 95 %": some["mm"].quantile(0.95),
            "degrees": some["degrees"].median(),
        }
        for (marker, condition), some in shots.groupby(["marker", "condition"], sort=False)
    ]
    return pd.DataFrame(rows)


def _melt_errors(table: pd.DataFrame) -> pd.DataFrame:
    """Make a row of each error; ``small`` marks the smaller images."""
    rows = table.assign(small=table["image_size"] == SMALL)
    kept = [name for name in rows.columns if name not in _ERRORS]
    rows = rows.melt(kept, list(_ERRORS), var_name="of", value_name="error")
    return rows.assign(of=rows["of"].map(_ERRORS))


def _draw_errors(table: pd.DataFrame, parameter: str, title: str) -> Figure:
    labels = {"distance_m": "distance, m", "angle_deg": "angle, degrees", "error": ""}
    look: Any = {"panels": "of", "lines": "marker", "share_y": False, "labels": labels}
    return draw_lines(_melt_errors(table), parameter, "error", title, log="y", **look)


def _draw_views() -> Figure:
    """Draw each condition in a row and each body in a column, cut from the image around it."""
    cut = 240  # pixels
    renderers = {name: RenderedView(WEBCAMS[SMALL], MARKERS[name].body) for name in MARKERS}
    grid: dict[str, dict[str, np.ndarray]] = {}
    for condition, (settings, _) in CONDITIONS.items():
        grid[condition] = {}
        for name, renderer in renderers.items():
            case = TrackingCase(name, SMALL, 0.4, 30.0, condition)
            pose, body = case.make_sequence(0)[0], MARKERS[name].body
            image = renderer.render(pose, settings, 3, case.compute_motion(0))
            middle = WEBCAMS[SMALL].project_points(
                pose.transform_points(body.centres.mean(axis=0)[None])
            )[0]
            left, top = np.clip(middle - cut / 2, 0, np.array(image.shape)[::-1] - cut).astype(int)
            grid[condition][name] = image[top : top + cut, left : left + cut]
    return draw_image_grid(grid, "Bodies and conditions, at 0.4 m and 30°")


TRACKING = Subject(
    "tracking",
    "Tracking: error against run time",
    _plan_pieces,
    _report,
    hidden=("shots",),
    libraries=("opencv-python-headless", "opencv-python"),
)
