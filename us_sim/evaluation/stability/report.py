"""What came of all extreme cases, in Markdown with maps, and as a table in the terminal."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from us_sim.evaluation.machine import machine
from us_sim.evaluation.stability.plots import draw_map, draw_step_limits
from us_sim.tissue.solvers.solver import SOLVERS

if TYPE_CHECKING:
    from us_sim.evaluation.stability.measure import Tried

__all__ = ["print_table", "write_report"]

_HEADER = (
    "method",
    "cases",
    "refused",
    "failed",
    "not finite",
    "not bounded",
    "not truthful",
    "back to rest",
    "frames",
    "kept",
    "slowest ms",
)

_DEFINITIONS = """\
Every case is a small tissue (4 to 150 nodes), a collider and a motion of it, and then its release.

- *finite*: all nodes, force, torque and residual of all frames.
- *bounded*: no node is ever farther from its rest than three times the mesh's diagonal, the depth
  and the collider together; a part that nothing holds may also drift off by ten times its size.
- *back to rest*: at the end, the farthest node is within 1e-4 of the thickness from its rest (parts
  that nothing holds: after a rigid motion). Quasi-static methods are given 40 frames, the others
  150, whatever their time step is: 20 steps of 1 µs, or damping of 1000 times critical, leave no
  time to come back, which is physics and not counted as a failure. *frames* is the median number
  of frames until then.
- *truthful*: in every frame that was compared, the reported residual and the one computed from the
  returned nodes by other code (NumPy, double precision, from the method's equations:
  `us_sim/evaluation/independent_residual.py`) are within a factor of two, or both below 1e-5, or
  both below what rounding the nodes' coordinates to doubles makes.
- *kept*: frames that failed, after which the solver itself kept the last good state or rest.
- *refused*: in one sentence, before the run. To be refused for no reason counts as failed, and so
  does not to refuse a tissue that can move as a whole (quasi-static methods) or broken input.
- critical damping is that of the root mean square of the nodes' frequencies.
"""


def print_table(tried: Sequence[Tried], out: Path) -> None:
    """The numbers of each method, the failures, and where everything is."""
    rows = [_HEADER, *(_numbers(method, tried) for method in _methods(tried))]
    widths = [max(len(row[i]) for row in rows) for i in range(len(_HEADER))]
    for row in rows:
        print("  ".join(text.rjust(width) for text, width in zip(row, widths, strict=True)))
    limits = _step_limits(tried)
    if limits:
        print(f"step limit of msds: {limits}")
    failed = [one for one in tried if not one.trial.passed]
    for one in failed[:10]:
        print(f"failed: {one.method}, {one.name}: {_failure(one)}")
    if len(failed) > 10:
        print(f"and {len(failed) - 10} more, see stability.csv")
    print(f"written to {out}: stability.csv, stability.md, stability_*.png")


def write_report(tried: Sequence[Tried], out: Path, quick: bool, seconds: float) -> None:
    """Write stability.md and its pictures."""
    command = f"us-sim evaluate stability{' --quick' if quick else ''}"
    lines = [
        "# Stability of the tissue solvers",
        "",
        f"`{command}`, {seconds:.0f} s in two processes, on {machine('numpy', 'scipy', 'numba')}.",
        "",
        _DEFINITIONS,
        "| " + " | ".join(_HEADER) + " |",
        "|" + " --- |" * len(_HEADER),
        *("| " + " | ".join(_numbers(method, tried)) + " |" for method in _methods(tried)),
        "",
    ]
    lines += _failures(tried)
    limits = [one for one in tried if not math.isnan(one.trial.step_limit_predicted)]
    if limits:
        predicted = np.array([one.trial.step_limit_predicted for one in limits])
        observed = np.array([one.trial.step_limit_observed for one in limits])
        draw_step_limits(predicted, observed, out / "stability_step_limit.png")
        lines += ["## Step limit of msds", "", f"{_step_limits(tried)}.", ""]
        lines += ["![predicted and observed](stability_step_limit.png)", ""]
    for method in _methods(tried):
        of_method = [
            (one.case, one.trial) for one in tried if one.method == method and one.case is not None
        ]
        draw_map(method, of_method, out / f"stability_{method}.png")
        lines += [f"## {method}", "", f"![map](stability_{method}.png)", ""]
        lines += _worst([one for one in tried if one.method == method])
        lines += _said([one for one in tried if one.method == method])
    lines += _refusals(tried)
    (out / "stability.md").write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")


def _methods(tried: Sequence[Tried]) -> list[str]:
    return [method for method in SOLVERS if any(one.method == method for one in tried)]


def _numbers(method: str, tried: Sequence[Tried]) -> tuple[str, ...]:
    trials = [one.trial for one in tried if one.method == method]
    ran = [trial for trial in trials if not math.isnan(trial.recovered_mm)]
    back = [trial.recovery_frames for trial in ran if trial.recovery_frames is not None]
    return (
        method,
        str(len(trials)),
        str(sum(trial.refused for trial in trials)),
        str(sum(not trial.passed for trial in trials)),
        str(sum(not trial.finite for trial in trials)),
        str(sum(not trial.bounded for trial in trials)),
        str(sum(not trial.truthful for trial in trials)),
        f"{100 * len(back) / max(len(ran), 1):.1f} %",
        f"{np.median(back):.0f}" if back else "",
        str(sum(trial.kept for trial in trials)),
        f"{max((trial.slowest_ms for trial in trials), default=0.0):.0f}",
    )


def _step_limits(tried: Sequence[Tried]) -> str:
    ratios = [
        one.trial.step_limit_observed / one.trial.step_limit_predicted
        for one in tried
        if not math.isnan(one.trial.step_limit_predicted)
    ]
    if not ratios:
        return ""
    deviation = np.abs(np.array(ratios) - 1)
    return (
        f"{len(ratios)} cases bisected, observed and predicted limits differ by "
        f"{100 * np.median(deviation):.2f} % (median) and {100 * deviation.max():.2f} % (largest)"
    )


def _failure(one: Tried) -> str:
    trial = one.trial
    if trial.failure:
        return trial.failure
    if not trial.finite:
        return "not finite"
    if not trial.bounded:
        return "not bounded"
    return (
        f"reported a residual of {trial.residual_reported:.3g}, but it is "
        f"{trial.residual_checked:.3g}"
    )


def _failures(tried: Sequence[Tried]) -> list[str]:
    failed = [one for one in tried if not one.trial.passed]
    if not failed:
        return ["No case failed.", ""]
    lines = ["## Failures", "", "| method | case | what |", "| --- | --- | --- |"]
    lines += [f"| {one.method} | {one.name} | {_failure(one)} |" for one in failed[:60]]
    if len(failed) > 60:
        lines += ["", f"and {len(failed) - 60} more, see stability.csv"]
    return [*lines, ""]


def _worst(tried: Sequence[Tried]) -> list[str]:
    """Of those that ran: the five farthest from rest, and the five with the largest residual."""
    ran = [one for one in tried if not math.isnan(one.trial.recovered_mm) and one.case is not None]
    lines = []
    far = [one for one in ran if one.trial.recovery_frames is None]
    if far:
        lines += ["Farthest from rest after release:", ""]
        far.sort(key=lambda one: -one.trial.recovered_mm)
        lines += [f"- {one.trial.recovered_mm:.3g} mm: {_described(one)}" for one in far[:5]]
        lines += [""]
    large = [one for one in ran if one.trial.residual_checked > 1e-2]
    if large:
        lines += [f"Residual above 1e-2 under the probe in {len(large)} cases; the largest:", ""]
        large.sort(key=lambda one: -one.trial.residual_checked)
        lines += [f"- {one.trial.residual_checked:.3g}: {_described(one)}" for one in large[:5]]
        lines += [""]
    return lines


def _described(one: Tried) -> str:
    case = one.case
    if case is None:
        return one.name
    text = (
        f"{one.name} ({case.young_modulus:.2g} Pa, contrast {case.contrast:.2g}, "
        f"ν = {case.poisson_ratio:.5g}, {case.motion} to {100 * case.depth:.0f} % of the depth, "
        f"{case.mesh}, {case.collider}, held: {case.support}"
    )
    if one.method.startswith("msds"):
        text += f", {case.time_step:.2g} s steps, damping {case.damping:.2g}, {case.springs}"
    return text + ")"


def _said(tried: Sequence[Tried]) -> list[str]:
    """What the solver said it did, with its numbers taken out, and in how many cases."""
    counted: Counter[str] = Counter()
    for one in tried:
        if not one.trial.refused:
            parts = (part for action in one.trial.actions for part in action.split("; "))
            counted.update({re.sub(r"\d[\d.e+-]*", "#", part) for part in parts})
    if not counted:
        return []
    lines = ["What it said it did (numbers left out), in how many cases:", ""]
    return [*lines, *(f"- {number}: {said}" for said, number in counted.most_common(12)), ""]


def _refusals(tried: Sequence[Tried]) -> list[str]:
    lines = ["## Refused, and with what words", "", "| case | methods | sentence |"]
    lines += ["| --- | --- | --- |"]
    seen: dict[str, tuple[str, list[str]]] = {}
    for one in tried:
        if one.trial.refused:
            sentence = one.trial.actions[0].removeprefix("refused: ")
            key = re.sub(r"\d[\d.e+-]*", "#", sentence.replace(one.method, ""))
            methods = seen.setdefault(key, (f"{one.name} | {{}} | {sentence}", []))[1]
            if one.method not in methods:
                methods.append(one.method)
    for text, methods in seen.values():
        name, _, sentence = text.split(" | ", 2)
        lines += [f"| {name} | {', '.join(methods)} | {sentence} |"]
    return [*lines, ""]
