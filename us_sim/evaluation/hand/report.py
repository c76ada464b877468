"""`us-sim evaluate hand`: error and delay of every method behind a hand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import pandas as pd

from us_sim.evaluation.figures import draw_lines
from us_sim.evaluation.hand.hand_motion import KINDS, RATE
from us_sim.evaluation.hand.measure import list_motions, measure_motion
from us_sim.evaluation.settings import HandSettings
from us_sim.evaluation.subject import Piece, Report, Subject, Target
from us_sim.evaluation.tissue_methods import TISSUE_METHODS

JUDGED = "fem_nonlinear"  # the method of the targets


def _plan_pieces(
    quick: bool, settings: HandSettings | None = None
) -> Mapping[str, Sequence[Piece]]:
    return {
        "hand": [
            Piece(
                {"kind": motion.kind, "haste": motion.haste, "seed": motion.seed, "method": method},
                partial(measure_motion, motion, method),
            )
            for motion in list_motions(quick, (settings or HandSettings()).seed)
            for method in TISSUE_METHODS
        ]
    }


def _join_frames(table: pd.DataFrame, frames: str) -> pd.DataFrame:
    """Join the frames of all rows, each with its row's motion and method."""
    rows = [
        row[frames].assign(motion=row["motion"], method=row["method"])
        for _, row in table.iterrows()
    ]
    # Where a method failed there are none.
    columns = ["residual", "cpu", "error", "latency", "inverted"]
    return pd.concat(rows or [pd.DataFrame(columns=columns, dtype=float)])


def _report(table: pd.DataFrame) -> Report:
    table = table.assign(motion=table["kind"] + ", " + table["haste"])
    judged = table[table["method"] == JUDGED]
    brisk = table[table["haste"] == "brisk"]
    ours = brisk[brisk["method"] == JUDGED]
    every, live = _join_frames(ours, "every"), _join_frames(ours, "live")
    balanced = 100 * (every["residual"] <= 1e-2).mean()
    wrong = (judged["frames_inverted"] + judged["live_frames_inverted"]).sum()
    late, skipped = live["latency"].quantile(0.99), 100 * ours["live_skipped"].mean()
    away = ours["live_away_ms"].max()
    limits: Sequence[tuple[str, float, float, str]] = (
        ("brisk: ms a frame (processor), median", 8, every["cpu"].median(), "ms"),
        ("brisk: likewise, 99th percentile", 33, every["cpu"].quantile(0.99), "ms"),
        ("brisk: live, mm to the converged answer, median", 0.05, live["error"].median(), "mm"),
        ("brisk: live, ms in which a node is over 1 mm off, longest", 50, away, "ms"),
        ("brisk: live, ms from a pose to its nodes, 99th percentile", 25, late, "ms"),
        ("brisk: live, % of poses skipped", 5, skipped, ""),
        ("all motions: frames with inverted tetrahedra", 0, wrong, ""),
    )
    targets = [
        Target.at_least("brisk: % of frames with a residual of at most 0.01", 99.0, balanced),
        *(Target.at_most(*limit) for limit in limits),
    ]
    free = table[table["kind"] == "free"]
    frames = _join_frames(table, "every")
    inverted = frames.groupby("method", sort=False)["inverted"].apply(lambda n: (n > 0).mean())
    linear = _join_frames(brisk[brisk["method"] == "fem"], "every")
    take_home = [
        f"In a brisk hand on the arm, the worst node of `{JUDGED}` is {every['error'].median():.2g}"
        f" mm off (median frame; {every['error'].quantile(0.99):.2g} mm at the 99th percentile), "
        f"in {every['cpu'].median():.2g} ms.",
        f"Live, it is {live['error'].median():.2g} mm off, skips {skipped:.2g} % of the poses, and "
        f"publishes nodes {late:.2g} ms after their pose (99th percentile).",
        f"`fem` needs {linear['cpu'].median():.2g} ms, and its linear strain is "
        f"{linear['error'].median():.2g} mm off there.",
        "Frames with tetrahedra inside out, all motions: "
        + ", ".join(f"`{name}` {100 * part:.2g} %" for name, part in inverted.items())
        + ".",
    ]
    points = [
        free.assign(ms=free[f"cpu_ms_{part}"], mm=free[f"error_mm_{part}"], median=part == "p50")
        for part in ("p50", "p99")
    ]
    places = {
        "judged": JUDGED,
        "error": draw_lines(
            pd.concat(points),
            "ms",
            "mm",
            "Error of the worst node over run time (full: median frame; hollow: 99th percentile)",
            panels="motion",
            lines="method",
            filled="median",
            log="xy",
            floor=1e-3,
            limits={"16.7 ms: 60 Hz": 1e3 / RATE},
            labels={"ms": "processor time of a frame, ms", "mm": "error of the worst node, mm"},
        ),
        "motions": table.filter(
            regex="^(kind|haste|method|(error_mm|cpu_ms)_p(50|99)|residual_p50|frames_inverted)$"
        ),
        "live": table.filter(
            regex="^(kind|haste|method|live_(skipped|error_mm_.*|away_ms|latency_ms_p99))$"
        ),
        "kinds": [f"{name}: {kind.words}" for name, kind in KINDS.items()],
    }
    return Report(take_home, places, targets)


HAND = Subject(
    "hand",
    "A hand: error, residual and run time of every method",
    _plan_pieces,
    _report,
    hidden=("every", "live"),
)
