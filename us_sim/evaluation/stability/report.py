"""`us-sim evaluate stability`: try to break every tissue solver, and report its faults."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any
from unittest.mock import patch

import pandas as pd
from threadpoolctl import threadpool_limits

from us_sim.evaluation.figures import draw_lines
from us_sim.evaluation.stability.cases import (
    StabilityCase,
    list_extreme_cases,
    make_model,
    sample_cases,
    sample_held_cases,
)
from us_sim.evaluation.stability.measure import try_case
from us_sim.evaluation.subject import Piece, Report, Subject
from us_sim.evaluation.tissue_methods import LOOKS, TISSUE_METHODS
from us_sim.tissue.solvers.solver import create_solver


def plan_pieces(quick: bool) -> dict[str, list[Piece]]:
    """Plan every case for every method; the cases are the same in every run."""
    cases = [*list_extreme_cases(), *sample_cases(32 if quick else 1024)]
    cases += sample_held_cases(24 if quick else 500, 1)
    return {"stability": plan_cases(cases)}


def plan_cases(cases: Sequence[StabilityCase]) -> list[Piece]:
    """Plan these cases for every method."""
    bench = StabilityBench()
    pieces = []
    for name, method in TISSUE_METHODS.items():
        for case in cases:
            varied: dict[str, Any] = asdict(case)
            if not method.is_dynamic:
                varied |= dict.fromkeys(("time_step", "damping", "stabilisation"))
            pieces.append(Piece({"method": name, **varied}, partial(bench.run_case, name, case)))
    return pieces


class StabilityBench:
    """A bench that runs cases, with the solvers' cache in a temporary folder."""

    def __init__(self) -> None:
        self._cache = tempfile.TemporaryDirectory(prefix="us-sim-stability-")
        self._warm: set[str] = set()

    def run_case(self, method: str, case: StabilityCase) -> Iterator[dict[str, Any]]:
        """Run a case, and yield its row."""
        cache = {"US_SIM_CACHE": self._cache.name}
        with threadpool_limits(1), patch.dict(os.environ, cache):
            if method not in self._warm:  # so that no frame has to compile
                create_solver(method, make_model(StabilityCase("box"))).warm_up()
                self._warm.add(method)
            trial = try_case(method, case)
        ran = {} if trial.refusal else asdict(trial)
        fault = trial.fault
        remarks = [f"FAILED: {fault}"] if fault else []
        remarks += [f"refused: {trial.refusal}"] if trial.refusal else []
        yield {
            "recovery_frames": ran.get("recovery_frames"),
            "frames_to_1e-3": trial.frames_to_balance if trial.held else None,
            "held_residual": trial.held[-1] if trial.held else None,
            "held_inverted": bool(trial.held_inverted) if trial.held else None,
            **{name: ran.get(name) for name in _RAN},
            "action": " | ".join([*remarks, *map("; ".join, trial.actions[:3])]),
            "failure": fault,
            "refused": bool(trial.refusal),
            "kept": trial.kept,
            "slowest_ms": trial.slowest_ms,
        }


_RAN = ("finite", "bounded", "recovered_mm", "residual_reported", "residual_checked", "truthful")
"""Columns of cases that were not refused."""


def report_stability(rows: pd.DataFrame) -> Report:
    """Count the faults, and draw residuals and recovery over what makes a case hard."""
    failed = int((rows["failure"] != "").sum())
    held = rows[rows["held_residual"].notna()]
    take_home = [
        f"{len(rows):,} cases, {failed} failed: a case fails if the tissue is not finite or "
        f"bounded, reports a wrong residual, is refused for no reason, or stays out of balance."
    ]
    for name, method in TISSUE_METHODS.items():
        own = held[held["method"] == name]
        if len(own):
            balanced = 100 * own["frames_to_1e-3"].notna().mean()
            inverted = int(own["held_inverted"].sum())
            take_home.append(
                f"`{name}`: in {balanced:.1f} % of {len(own)} anatomical cases the tissue "
                f"balanced to 0.001 under a held probe, in {inverted} with tetrahedra inside out"
                f"{' (which would count as failed)' if method.is_judged_at_rest else ''}."
            )
    ran = rows[~rows["refused"]].assign(softness=0.5 - rows["poisson_ratio"])
    labels = {"contrast": "contrast within the mesh", "softness": "0.5 - Poisson's ratio"}
    labels |= {"residual_checked": "residual under the probe", "recovered_mm": "mm from rest"}
    figures = {
        name: draw_lines(
            *(ran, x, y, title),
            panels="method",
            lines="method",
            looks=LOOKS,
            labels=labels,
            log="xy",
            join=False,
            floor=floor,
        )
        for name, x, y, title, floor in (
            ("residual", "contrast", "residual_checked", _CHECKED, 1e-12),
            ("recovery", "softness", "recovered_mm", "Farthest from rest after release", 1e-6),
        )
    }
    return Report(take_home, {"counts": _count_faults(rows), **figures})


def _count_faults(rows: pd.DataFrame) -> pd.DataFrame:
    """Count the faults of each method in all cases."""
    counts = []
    for name, own in rows.groupby("method", sort=False):
        ran = own[~own["refused"]]
        counts.append(
            {
                "method": name,
                "cases": len(own),
                "refused": int(own["refused"].sum()),
                "failed": int((own["failure"] != "").sum()),
                **{f"not {word}": int((ran[word] == False).sum()) for word in _LAWS},  # noqa: E712
                "back to rest, %": 100 * ran["recovery_frames"].notna().mean(),
                "frames, median": ran["recovery_frames"].astype(float).median(),
                "kept": int(own["kept"].sum()),
                "slowest ms": own["slowest_ms"].max(),
            }
        )
    return pd.DataFrame(counts)


_CHECKED = "Residual under the probe, as checked"
_LAWS = ("finite", "bounded", "truthful")


STABILITY = Subject(
    "stability",
    "Stability of the tissue solvers",
    plan_pieces,
    report_stability,
    hidden=("failure", "refused", "kept", "slowest_ms"),
    digits=6,
)
