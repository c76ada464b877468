"""hand.md: what was asked and seen, the pictures, the tables, and how it was measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from us_sim.evaluation.hand.cases import APPROACH, MAIN_TISSUE, RATE, TISSUES, Motion
from us_sim.evaluation.hand.converged import CONVERGED, HELD, TRUSTED, Converged
from us_sim.evaluation.hand.plots import plot_errors, plot_faults, plot_hold, plot_time
from us_sim.evaluation.hand.points import ENOUGH, HOLD, OWN_EVERY, Point, those
from us_sim.evaluation.hand.targets import JUDGED, targets
from us_sim.evaluation.markdown_table import markdown_table
from us_sim.evaluation.report_folder import ReportFolder
from us_sim.evaluation.row import failures
from us_sim.evaluation.target import target_table
from us_sim.recording.hand_motion import HASTES, KINDS

_COLUMNS = 3  # motions that are drawn over time

_HEAD = (
    *("mm, p50", "p95", "p99", "worst", "to own balance: mm, p50", "worst"),
    *("residual, p50", "p99", "> 0.01", "> 0.1", "> 1"),
    *("inverted", "ms, p50", "p99", "worst"),
)
_LIVE = (
    *("poses", "skipped", "mm, p50", "p99", "worst", "latency ms, p50", "p99", "inverted"),
    *("held: frames to 0.01", "to 0.001", "residual in the end", "inverted then"),
)


def table(points: Sequence[Point]) -> str:
    """What the command prints: every measure that is asked for, and what was seen."""
    return target_table(targets(points))


def write_report(
    folder: ReportFolder, points: Sequence[Point], answers: Mapping[Motion, Converged]
) -> None:
    """Draw the plots and write hand.md."""
    free = [motion for motion in answers if motion.kind == "free"]
    others = [motion for motion in answers if motion.kind != "free"]
    main = [motion for motion in free if motion.tissue == MAIN_TISSUE]
    rest = [motion for motion in (*free, *others) if motion not in main]
    rest.sort(key=lambda motion: motion.tissue == MAIN_TISSUE)  # one of another tissue first
    overtime = [*main, *rest][:_COLUMNS]
    plot_time(points, overtime, answers, folder.picture("time"))
    plot_errors(points, list(answers) if folder.quick else free, folder.picture("error"))
    plot_faults(points, folder.picture("faults"))
    plot_hold(points, folder.picture("hold"))
    folder.write_report(_parts(folder, points, answers), failures(points))


def _parts(
    folder: ReportFolder, points: Sequence[Point], answers: Mapping[Motion, Converged]
) -> list[str]:
    seeds = ", ".join(str(seed) for seed in dict.fromkeys(motion.seed for motion in answers))
    hastes = "; ".join(
        f"{name}: {1e3 * asked.speed:.0f} mm/s and {np.degrees(asked.turning):.0f}°/s"
        for name, asked in HASTES.items()
    )
    return [
        "# A hand: error, residual and run time of every method",
        folder.opening("numpy", "scipy", "numba"),
        "A hand moves the probe as `us_sim.recording.hand_motion` says: smoothly, at random, and "
        f"as fast as asked, in medians over a motion ({hastes}; seed {seeds}). Every method "
        f"follows every pose at {RATE:.0f} Hz, however long it takes; then once more live, where "
        "a frame that takes longer costs poses; and at the end of the motion the probe is held "
        "still.",
        f"## What is asked of `{JUDGED}`",
        table(points),
        "Where nothing else is said, all kinds of motion count together, and with every pose fed.",
        "## Error over time",
        "![Error over time](hand_time.png)",
        "The error is that of the node that is farthest from where it is in the converged answer "
        "at the same pose. What is off by less than 0.001 mm is drawn there. The other methods "
        "solve other equations (linear elasticity, springs), so that their error has a part which "
        "no patience would take away: [the tissue report](../tissue/tissue.md) tells the two "
        "apart.",
        "## Error against run time",
        "![Error against run time](hand_error.png)",
        _by_motion(points, free_only=not folder.quick),
        "## What goes wrong",
        "![What goes wrong](hand_faults.png)",
        "A residual is what the method says of its own equations: unbalanced over contact forces. "
        "Above 1 it has not found a balance at all. Inverted tetrahedra are counted from the "
        "returned nodes.",
        "## Live, and held",
        "![A held probe](hand_hold.png)",
        _live(points),
        "Live, a frame begins with the newest pose that has come by then (the wall clock's time, "
        "that other programs on the machine lengthen); errors are to the converged answer at the "
        "pose that the frame is of, and the latency is from that pose to its nodes. Held, the "
        f"probe stays at the last pose of the motion that touches the tissue, for {HOLD} frames.",
        "## Motions and tissues",
        "\n".join(f"- `{name}`: {tissue.words}" for name, tissue in TISSUES.items()),
        "\n".join(f"- {name}: {kind.words}" for name, kind in KINDS.items()),
        "## The converged answer",
        _answers(answers),
        "It is that of `fem_nonlinear` with the greatest patience "
        "(`us_sim/evaluation/tissue_methods.py`), which follows the same poses and is called "
        f"again at each until its residual is {CONVERGED:g}, it has settled, or it goes no "
        f"further. Frames at whose pose it is above {TRUSTED:g}, or at which a fixed node has "
        f"moved by more than {1e3 * HELD:g} mm, are not compared (`not_compared` in the CSV); "
        f"where these are more than {100 * (1 - ENOUGH):.0f} % no errors are told of.",
        "Tissue under an edge that digs in may be in balance in more than one way, as a crease "
        "that stays or smooths out, and what follows the same poses less patiently may end in "
        f"another. So one in {OWN_EVERY} frames of `fem_nonlinear` is also compared with what it "
        "itself converges to at its pose (own balance): that is what haste costs, and the "
        "difference of the two errors is what comes of the past.",
        "## How it was measured",
        f"The probe comes from above the skin in {APPROACH:g} s to where the motion begins; those "
        "frames do not count. Every motion begins with tissue at rest. Times in the tables are "
        "processor time of the whole process, with one thread for linear algebra; the CSV has the "
        "wall clock's beside them.",
    ]


def _by_motion(points: Sequence[Point], *, free_only: bool) -> str:
    rows = []
    for p in those(points, kind="free" if free_only else None):
        values = p.values
        told = p.frames.compared >= ENOUGH
        numbers = [
            *(values[f"error_mm_{w}"] if told else np.nan for w in ("p50", "p95", "p99", "worst")),
            *(values[f"own_error_mm_{which}"] for which in ("p50", "worst")),
            *(values[f"residual_{which}"] for which in ("p50", "p99")),
        ]
        percents = [values[f"residual_over_{limit}"] for limit in ("0.01", "0.1", "1")]
        rows.append(
            (
                *(str(p.motion), _name(p.method)),
                *map(_number, numbers),
                *map(_percent, percents),
                f"{values['frames_inverted']}",
                *(_number(values[f"cpu_ms_{which}"]) for which in ("p50", "p99", "worst")),
            )
        )
    return markdown_table(("motion", "method", *_HEAD), rows)


def _live(points: Sequence[Point]) -> str:
    rows = []
    for p in those(points):
        values, told = p.values, p.live.frames.compared >= ENOUGH
        rows.append(
            (
                *(str(p.motion), _name(p.method), f"{p.live.poses}"),
                _percent(values["live_skipped"]),
                *(
                    _number(values[f"live_error_mm_{which}"]) if told else ""
                    for which in ("p50", "p99", "worst")
                ),
                *(_number(values[f"live_latency_ms_{which}"]) for which in ("p50", "p99")),
                f"{values['live_frames_inverted']}",
                *(_frames(values[f"hold_frames_to_{small}"]) for small in ("1e-2", "1e-3")),
                _number(values["hold_residual"]),
                "yes" if p.held.inverted else "",
            )
        )
    return markdown_table(("motion", "method", *_LIVE), rows)


def _answers(answers: Mapping[Motion, Converged]) -> str:
    rows = [
        (
            *(str(motion), f"{len(answer.residual)}"),
            _percent(float((answer.residual <= CONVERGED).mean())),
            _percent(float(answer.trusted.mean())),
            *(_number(float(x)) for x in (answer.residual.max(), answer.smallest.min())),
            _number(1e3 * float(answer.slipped.max())),
        )
        for motion, answer in answers.items()
    ]
    head = ("motion", "poses", f"residual ≤ {CONVERGED:g}", f"≤ {TRUSTED:g}", "largest residual")
    return markdown_table((*head, "smallest volume ratio", "mm a fixed node moved"), rows)


def _name(method: str) -> str:
    return f"**{method}**" if method == JUDGED else method


def _number(value: object) -> str:
    assert isinstance(value, float)
    return f"{value:.2g}" if np.isfinite(value) else ""


def _percent(value: object) -> str:
    assert isinstance(value, float)
    return f"{100 * value:.3g} %" if np.isfinite(value) else ""


def _frames(value: object) -> str:
    assert isinstance(value, float)
    return f"{value:.0f}" if np.isfinite(value) else "never"
