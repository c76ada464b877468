"""`us-sim evaluate hand`: how far the tissue of every method is behind a hand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
import pandas as pd

from us_sim.evaluation.figures import draw_error_over_time, draw_lines
from us_sim.evaluation.hand.hand_motion import KINDS, RATE
from us_sim.evaluation.hand.measure import (
    AWAY,
    HOLD,
    MAIN_TISSUE,
    TISSUES,
    Bench,
    motions,
)
from us_sim.evaluation.settings import HandSettings
from us_sim.evaluation.subject import Piece, Report, Subject, Target
from us_sim.evaluation.tissue_methods import TISSUE_METHODS

JUDGED = "fem_nonlinear"  # the method that the targets are for

_BY_MOTION = {
    "motion": "motion",
    "method": "method",
    "error_mm_p50": "mm, p50",
    "error_mm_p99": "p99",
    "error_mm_worst": "worst",
    "own_error_mm_p50": "to own balance: mm, p50",
    "residual_p50": "residual, p50",
    "residual_over_0.01": "part > 0.01",
    "residual_over_1": "part > 1",
    "frames_inverted": "inverted",
    "cpu_ms_p50": "ms, p50",
    "cpu_ms_p99": "ms, p99",
}
_LIVE = {
    "motion": "motion",
    "method": "method",
    "live_skipped": "part skipped",
    "live_error_mm_p50": "mm, p50",
    "live_error_mm_worst": "worst",
    "live_away_ms": "ms off",
    "live_latency_ms_p50": "latency ms, p50",
    "live_latency_ms_p99": "p99",
    "live_frames_inverted": "inverted",
    "hold_frames_to_1e-2": "held: frames to 0.01",
    "hold_frames_to_1e-3": "to 0.001",
    "hold_residual": "residual in the end",
    "hold_inverted": "inverted then",
}


def _pieces(quick: bool, settings: HandSettings | None = None) -> Mapping[str, Sequence[Piece]]:
    bench = Bench()
    return {
        "hand": [
            Piece(
                {
                    "tissue": motion.tissue,
                    "kind": motion.kind,
                    "haste": motion.haste,
                    "seed": motion.seed,
                    "method": method,
                },
                partial(bench.row, motion, method),
            )
            for motion in motions(quick, (settings or HandSettings()).seed)
            for method in TISSUE_METHODS
        ]
    }


def targets(table: pd.DataFrame) -> list[Target]:
    """Limits for `JUDGED`, against the measured numbers."""
    mine = with_motion(table[table["method"] == JUDGED])
    arm = mine[mine["tissue"] == MAIN_TISSUE]
    brisk, careful = arm[arm["haste"] == "brisk"], arm[arm["haste"] == "careful"]
    violent = mine[mine["haste"] == "violent"]
    where = f"brisk on the {MAIN_TISSUE}"
    frames, live = _joined(brisk, "every"), _joined(brisk, "live")

    def within(what: str, asked: float, some: pd.DataFrame, limit: float) -> Target:
        percent = 100 * (some["residual"] <= limit).mean()
        return Target.at_least(f"{what}: % of frames with a residual of at most {limit:g}", asked,
                               percent, form=".4g")  # fmt: skip

    def rest(what: str, limit: int, some: pd.DataFrame, column: str) -> Target:
        """Frames after the probe has stopped until the residual is small; NaN is never."""
        worst = some[column].astype(float).fillna(np.inf).max()
        if worst == np.inf:
            return Target(what, f"at most {limit}", "never in some motion", False)
        return Target.at_most(what, limit, worst, form="g")

    limits: Sequence[tuple[str, float, float, str]] = (
        (f"{where}: ms a frame (processor), median", 8, frames["cpu"].median(), "ms"),
        (f"{where}: likewise, 99th percentile", 33, frames["cpu"].quantile(0.99), "ms"),
        (f"{where}: mm to its own balance, median", 0.05, frames["own"].median(), "mm"),
        (f"{where}: likewise, 99th percentile", 0.5, frames["own"].quantile(0.99), "mm"),
        (f"live, {where}: mm to the converged answer, median", 0.05, live["error"].median(), "mm"),
        (
            f"live, {where}: ms in which a node is over {AWAY:g} mm off, longest",
            50,
            brisk["live_away_ms"].max(),
            "ms",
        ),
        (
            f"live, {where}: ms from a pose to its nodes, 99th percentile",
            25,
            live["latency"].quantile(0.99),
            "ms",
        ),
        (f"live, {where}: % of poses skipped", 5, 100 * brisk["live_skipped"].mean(), ""),
        (
            "all motions: frames with inverted tetrahedra",
            0,
            (mine["frames_inverted"] + mine["live_frames_inverted"]).sum(),
            "",
        ),
        ("violent: ms of the slowest frame", 50, violent["wall_ms_worst"].max(), "ms"),
        ("all motions: mm that a fixed node moves", 0, mine["fixed_nodes_moved_mm"].max(), "mm"),
        ("all motions, then held: inverted in the end", 0, mine["hold_inverted"].sum(), ""),
    )
    return [
        within(where, 99.0, frames, 1e-2),
        within(where, 100.0, frames, 0.1),
        within(f"careful on the {MAIN_TISSUE}", 99.9, _joined(careful, "every"), 1e-2),
        *(Target.at_most(*limit) for limit in limits),
        rest("violent, then held: frames to a residual of 0.01, worst", 5, violent,
             "hold_frames_to_1e-2"),
        rest("all motions, then held: frames to a residual of 0.001, worst", 30, mine,
             "hold_frames_to_1e-3"),
    ]  # fmt: skip


def with_motion(table: pd.DataFrame) -> pd.DataFrame:
    """The table with the words of each row's motion."""
    return table.assign(motion=table["tissue"] + ", " + table["kind"] + ", " + table["haste"])


def _joined(table: pd.DataFrame, frames: str) -> pd.DataFrame:
    """Every frame of some rows, with the row's motion and method."""
    columns = ["residual", "cpu", "own", "error", "latency", "inverted", "s"]
    if table.empty:
        return pd.DataFrame(columns=columns, dtype=float)
    return pd.concat(
        [
            row[frames].assign(motion=row["motion"], method=row["method"])
            for _, row in table.iterrows()
        ]
    )


def _report(table: pd.DataFrame) -> Report:
    table = with_motion(table)
    free = table[table["kind"] == "free"]
    shown = list(dict.fromkeys([*free["motion"], *table["motion"]]))[:3]
    frames = _joined(table, "every")
    points = [
        {"motion": row["motion"], "method": row["method"], "ms": row[f"cpu_ms_{part}"],
         "mm": row[f"error_mm_{part}"], "median": part == "p50"}
        for _, row in (free if len(free) else table).iterrows()
        for part in ("p50", "p99")
    ]  # fmt: skip
    held = pd.DataFrame(
        [
            {"method": row["method"], "motion": row["motion"], "frame": k, "residual": residual}
            for _, row in table.iterrows()
            for k, residual in enumerate(row["hold"])
        ]
    )
    arm = table[(table["tissue"] == MAIN_TISSUE) & (table["haste"] == "brisk")]
    mine = arm[arm["method"] == JUDGED]
    judged, live = _joined(mine, "every"), _joined(mine, "live")
    inverted = frames.groupby("method", sort=False)["inverted"].apply(lambda n: (n > 0).mean())
    linear = _joined(arm[arm["method"] == "fem"], "every")
    take_home = [
        f"In a brisk hand on the arm `{JUDGED}` is {judged['error'].median():.2g} mm off where it "
        f"is worst (median frame; {judged['error'].quantile(0.99):.2g} mm at the 99th percentile), "
        f"in {judged['cpu'].median():.2g} ms.",
        f"Live, it is {live['error'].median():.2g} mm off, skips "
        f"{100 * mine['live_skipped'].mean():.2g} % of the poses, and shows nodes "
        f"{live['latency'].quantile(0.99):.2g} ms after their pose (99th percentile).",
        f"`fem` needs {linear['cpu'].median():.2g} ms, and its linear strain is "
        f"{linear['error'].median():.2g} mm off there.",
        "Frames with tetrahedra inside out, all motions: "
        + ", ".join(f"`{name}` {100 * part:.2g} %" for name, part in inverted.items())
        + ".",
    ]
    faults = frames.assign(
        **{f"residual > {limit:g}, %": 100.0 * (frames["residual"] > limit) for limit in (0.01, 1)},
        **{"inside out, %": 100.0 * (frames["inverted"] > 0)},
    )
    places = {
        "judged": JUDGED,
        "time": draw_lines(
            frames[frames["motion"].isin(shown)],
            "s",
            "error",
            "How far the farthest node is off while a hand moves (every pose fed)",
            panels="motion",
            lines="method",
            log="y",
            floor=1e-3,
            labels={"s": "time, s", "error": "error of the worst node, mm"},
        ),
        "error": draw_error_over_time(
            pd.DataFrame(points),
            "ms",
            "mm",
            "Error of the worst node over run time (full: median frame; hollow: 99th percentile)",
            panels="motion",
            lines="method",
            filled="median",
            floor=1e-3,
            limits={"16.7 ms: 60 Hz": 1e3 / RATE},
            labels={"ms": "processor time of a frame, ms", "mm": "error of the worst node, mm"},
        ),
        "motions": table[list(_BY_MOTION)].rename(columns=_BY_MOTION),
        "faults": faults.groupby("method", sort=False)[list(faults.columns[-3:])]
        .mean()
        .reset_index(),
        "hold_figure": draw_lines(
            held,
            "frame",
            "residual",
            "The probe is held still: does the tissue come to balance?",
            panels="method",
            lines="motion",
            log="y",
            floor=1e-9,
            limits={"y:asked: 0.001 in 30": 1e-3},
            labels={"frame": "frames after it stopped"},
        ),
        "live": table[list(_LIVE)].rename(columns=_LIVE),
        "hold": str(HOLD),
        "tissues": [f"`{name}`: {tissue.words}" for name, tissue in TISSUES.items()],
        "kinds": [f"{name}: {kind.words}" for name, kind in KINDS.items()],
    }
    return Report(take_home, places, targets(table))


HAND = Subject(
    "hand",
    "A hand: error, residual and run time of every method",
    _pieces,
    _report,
    hidden=("every", "live", "hold"),
)
