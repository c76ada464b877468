"""What came of all extreme cases, in Markdown with maps, and as a table in the terminal."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np

from us_sim.evaluation.markdown_table import markdown_table
from us_sim.evaluation.report_folder import ReportFolder
from us_sim.evaluation.row import failures
from us_sim.evaluation.stability.held_cases import HOLD, SMALL
from us_sim.evaluation.stability.plots import draw_map, draw_step_limits
from us_sim.evaluation.stability.points import Trial, Tried
from us_sim.evaluation.tissue_methods import TISSUE_METHODS

_HEAD = (
    *("method", "cases", "refused", "failed", "not finite", "not bounded", "not truthful"),
    *("back to rest", "frames", "kept", "slowest ms"),
)

_HELD_HEAD = (
    *("method", "judged", "cases", "residual ≤ 0.001", "inverted", "both fine", "frames, median"),
    *("95th percentile", "worst residual"),
)

_DEFINITIONS = """\
Every case is a small tissue (4 to 150 nodes), a collider and a motion of it, and then its release.

- *finite*: all nodes, force, torque and residual of all frames.
- *bounded*: no node is ever farther from its rest than three times the mesh's diagonal, the depth
  and the collider together; a part that nothing holds may also drift off by ten times its size.
- *back to rest*: at the end, the farthest node is within 1e-4 of the thickness from its rest (parts
  that nothing holds: after a rigid motion). Quasi-static methods have 40 frames for it, the others
  150, whatever their time step is: 20 steps of 1 µs, or damping of 1000 times critical, leave no
  time to come back, which is physics and not counted as a failure. *frames* is the median number
  of frames until then.
- *truthful*: in every frame that was compared, the reported residual and the one computed from the
  returned nodes by other code (NumPy, double precision, from the method's equations:
  `us_sim/evaluation/independent_residual.py`) are within a factor of two, or both below 1e-5, or
  both below what rounding the nodes' coordinates to doubles makes. Of `fem_nonlinear`, whose
  surface is pushed by springs, the other code finds the least that the residual can be, whatever
  springs push: there more may be reported, but not less. After a probe came down deep in tissue, it
  is not compared until that has settled.
- *kept*: frames that failed, after which the solver itself kept the last good state or rest.
- *refused*: in one sentence, before the run. To be refused for no reason counts as failed, and so
  does not to refuse a tissue that can move as a whole (quasi-static methods) or broken input.
- *held*: see below; a case of `fem_nonlinear` that does not come to balance counts as failed.
- critical damping is that of the root mean square of the nodes' frequencies."""


def table(tried: Sequence[Tried]) -> str:
    """What the command prints: the numbers of each method, and how well step limits are known."""
    rows = markdown_table(_HEAD, [_numbers(method, tried) for method in _methods(tried)])
    limits = [f"step limit of {name}: {said}" for name, said in _step_limits(tried).items()]
    return "\n".join([rows, *limits])


def write_report(folder: ReportFolder, tried: Sequence[Tried]) -> None:
    """Draw the maps and write stability.md."""
    failed = failures(tried)
    parts = [
        "# Stability of the tissue solvers",
        f"{folder.opening('numpy', 'scipy', 'numba')} Two processes shared the cases.",
        _DEFINITIONS,
        markdown_table(_HEAD, [_numbers(method, tried) for method in _methods(tried)]),
        "" if failed else "No case failed.",
    ]
    parts += _held(tried)
    for method, said in _step_limits(tried).items():
        limits = _with_step_limit(method, tried)
        predicted = np.array([trial.step_limit_predicted for trial in limits])
        observed = np.array([trial.step_limit_observed for trial in limits])
        picture = folder.picture(f"step_limit_{method}")
        draw_step_limits(method, predicted, observed, picture)
        parts += [f"## Step limit of {method}", f"{said}."]
        parts += [f"![predicted and observed]({picture.name})"]
    for method in _methods(tried):
        mine = [one for one in tried if one.method == method]
        picture = folder.picture(method)
        draw_map(method, mine, picture)
        parts += [f"## {method}", f"![map]({picture.name})", *_worst(mine), *_said(mine)]
    folder.write_report([*parts, *_refusals(tried)], failed)


def _held(tried: Sequence[Tried]) -> list[str]:
    """What came of the cases in which the probe was held, and who is judged by it."""
    rows = []
    for method in _methods(tried):
        held = [one.trial for one in tried if one.method == method and one.trial.held]
        if not held:
            continue
        frames = [n for n in (trial.frames_to_balance for trial in held) if n is not None]
        upright = [trial for trial in held if not trial.held_inverted]
        fine = [trial for trial in upright if trial.frames_to_balance is not None]
        typical = [f"{np.percentile(frames, part):.0f}" if frames else "" for part in (50, 95)]
        rows.append(
            (
                method,
                "yes" if TISSUE_METHODS[method].is_judged_at_rest else "",
                f"{len(held)}",
                f"{100 * len(frames) / len(held):.1f} %",
                f"{len(held) - len(upright)}",
                f"{100 * len(fine) / len(held):.1f} %",
                *typical,
                f"{max(trial.held[-1] for trial in held):.2g}",
            )
        )
    if not rows:
        return []
    judged = [f"`{name}`" for name, method in TISSUE_METHODS.items() if method.is_judged_at_rest]
    return [
        "## A probe that is held",
        "Within what anatomy is (1 to 100 kPa, contrasts up to 1000, Poisson's ratios of 0.3 to "
        f"0.495, presses of 5 to 50 % of the thickness), the probe then stays for {HOLD} frames, "
        f"after which the residual must be at most {SMALL:g} and no tetrahedron inside out. "
        f"{', '.join(judged)} is judged by it: its energy has a minimum under every probe, and a "
        "case in which it does not come there counts as failed. The others are only recorded. "
        "Linear strain (`fem`, `fem_cg`) knows no volume, so that deep presses turn tetrahedra "
        "inside out in the exact solution of its equations; springs have masses that swing on, "
        "and time steps that a frame has only so many of.",
        markdown_table(_HELD_HEAD, rows),
    ]


def _methods(tried: Sequence[Tried]) -> list[str]:
    return [method for method in TISSUE_METHODS if any(one.method == method for one in tried)]


def _numbers(method: str, tried: Sequence[Tried]) -> tuple[str, ...]:
    trials = [one.trial for one in tried if one.method == method]
    ran = [trial for trial in trials if not math.isnan(trial.recovered_mm)]
    back = [trial.recovery_frames for trial in ran if trial.recovery_frames is not None]
    return (
        method,
        f"{len(trials)}",
        f"{sum(trial.refused for trial in trials)}",
        *(
            f"{sum(not getattr(trial, name) for trial in trials)}"
            for name in ("passed", "finite", "bounded", "truthful")
        ),
        f"{100 * len(back) / max(len(ran), 1):.1f} %",
        f"{np.median(back):.0f}" if back else "",
        str(sum(trial.kept for trial in trials)),
        f"{max((trial.slowest_ms for trial in trials), default=0.0):.0f}",
    )


def _with_step_limit(method: str, tried: Sequence[Tried]) -> list[Trial]:
    trials = (one.trial for one in tried if one.method == method)
    return [trial for trial in trials if not math.isnan(trial.step_limit_predicted)]


def _step_limits(tried: Sequence[Tried]) -> dict[str, str]:
    """By method, for those of which a step limit was looked for: how good its prediction is."""
    said = {}
    for method in _methods(tried):
        limits = _with_step_limit(method, tried)
        if limits:
            ratios = [t.step_limit_observed / t.step_limit_predicted for t in limits]
            deviation = np.abs(np.array(ratios) - 1)
            said[method] = (
                f"{len(limits)} cases bisected, observed and predicted limits differ by "
                f"{100 * np.median(deviation):.2f} % (median) and {100 * deviation.max():.2f} % "
                f"(largest)"
            )
    return said


def _worst(tried: Sequence[Tried]) -> list[str]:
    """Of those that ran: the five farthest from rest, and the five with the largest residual."""
    ran = [one for one in tried if not math.isnan(one.trial.recovered_mm) and one.case is not None]
    parts = []
    far = [one for one in ran if one.trial.recovery_frames is None]
    if far:
        parts += ["Farthest from rest after release:"]
        parts += [_largest(far, lambda trial: trial.recovered_mm, " mm")]
    large = [one for one in ran if one.trial.residual_checked > 1e-2]
    if large:
        parts += [f"Residual above 1e-2 under the probe in {len(large)} cases; the largest:"]
        parts += [_largest(large, lambda trial: trial.residual_checked)]
    return parts


def _largest(tried: Sequence[Tried], value: Callable[[Trial], float], unit: str = "") -> str:
    worst = sorted(tried, key=lambda one: -value(one.trial))[:5]
    return "\n".join(f"- {value(one.trial):.3g}{unit}: {_described(one)}" for one in worst)


def _described(one: Tried) -> str:
    case = one.case
    if case is None:
        return one.name
    held = f", then held for {case.held} frames" if case.held else ""
    text = (
        f"{one.name} ({case.young_modulus:.2g} Pa, contrast {case.contrast:.2g}, "
        f"ν = {case.poisson_ratio:.5g}, {case.motion} to {100 * case.depth:.0f} % of the depth, "
        f"{case.mesh}, {case.collider}, held: {case.support}{held}"
    )
    if TISSUE_METHODS[one.method].has_springs:
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
    lines = [f"- {number}: {said}" for said, number in counted.most_common(12)]
    return ["What it said it did (numbers left out), in how many cases:", "\n".join(lines)]


def _refusals(tried: Sequence[Tried]) -> list[str]:
    """Each sentence once, though its numbers and the method in it differ."""
    seen: dict[str, tuple[str, str, list[str]]] = {}
    for one in tried:
        if one.trial.refused:
            sentence = one.trial.actions[0].removeprefix("refused: ")
            key = re.sub(r"\d[\d.e+-]*", "#", sentence.replace(one.method, ""))
            methods = seen.setdefault(key, (one.name, sentence, []))[2]
            if one.method not in methods:
                methods.append(one.method)
    rows = [(name, ", ".join(methods), sentence) for name, sentence, methods in seen.values()]
    words = "## Refused, and with what words"
    return [words, markdown_table(("case", "methods", "sentence"), rows)]
