"""hand.md: what was asked and seen, the pictures, the tables, and how it was measured.

What is asked of ``fem_nonlinear`` in a hand, against what was seen in one run.

Pictures of error over time, of error against run time, of what goes wrong, and of the hold.

`us-sim evaluate hand`: how tissue follows a hand, with every method.

Random motions of a hand (`us_sim.recording.hand_motion`) on several tissues are followed with every
pose, and live, where a frame that takes too long costs poses; then the probe is held still. What is
compared is where the nodes are with the converged answer at the same pose
(`us_sim.evaluation.hand.measure`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from us_sim.evaluation.hand.measure import (
    APPROACH,
    CONVERGED,
    ENOUGH,
    HELD,
    HOLD,
    MAIN_TISSUE,
    OWN_EVERY,
    RATE,
    TISSUES,
    TRUSTED,
    Converged,
    Motion,
    Point,
    _points,
    motions,
    those,
)
from us_sim.evaluation.report import (
    ReportFolder,
    Target,
    failures,
    key_beside,
    markdown_table,
    new_figure,
    plain,
    save,
    target_table,
)
from us_sim.evaluation.settings import HandSettings
from us_sim.evaluation.tissue_methods import TISSUE_METHODS
from us_sim.progress import Progress
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


JUDGED = "fem_nonlinear"
"""The method that the targets are for."""


def targets(points: Sequence[Point]) -> list[Target]:
    """Every measure that is asked for."""
    mine = those(points, method=JUDGED)
    brisk = those(mine, tissue=MAIN_TISSUE, haste="brisk")
    careful = those(mine, tissue=MAIN_TISSUE, haste="careful")
    violent = those(mine, haste="violent")
    where = f"brisk on the {MAIN_TISSUE}"
    return [
        _fraction(f"{where}: % of frames with a residual of at most 0.01", 99.0, brisk, 1e-2),
        _fraction(f"{where}: likewise 0.1", 100.0, brisk, 0.1),
        _most(f"{where}: ms a frame (processor), median", 8, brisk, _cpu, 50, "ms"),
        _most(f"{where}: likewise, 99th percentile", 33, brisk, _cpu, 99, "ms"),
        _most(f"{where}: mm to its own balance, median", 0.05, brisk, _own, 50, "mm"),
        _most(f"{where}: likewise, 99th percentile", 0.5, brisk, _own, 99, "mm"),
        _fraction(f"careful on the {MAIN_TISSUE}: % with at most 0.01", 99.9, careful, 1e-2),
        _off(f"live, {where}: mm to the converged answer, median", 0.05, brisk, 50),
        _off(f"live, {where}: likewise, 99th percentile", 0.5, brisk, 99),
        _most(
            *(f"live, {where}: ms from a pose to its nodes, 99th percentile", 25, brisk),
            *(lambda p: p.live.latency, 99, "ms"),
        ),
        Target.at_most(f"live, {where}: % of poses skipped", 5, _skipped(brisk)),
        Target.at_most("all motions: frames with inverted tetrahedra", 0, _inverted(mine)),
        _most("violent: ms of the slowest frame", 50, violent, lambda p: p.frames.wall, 100, "ms"),
        _most("all motions: mm that a fixed node moves", 0, mine, _slipped, 100, "mm"),
        _rest("violent, then held: frames to a residual of 0.01, worst", 5, violent, 1e-2),
        _rest("all motions, then held: frames to a residual of 0.001, worst", 30, mine, 1e-3),
        Target.at_most(
            "all motions, then held: inverted in the end",
            0,
            sum(p.held.inverted > 0 for p in mine) if mine else np.nan,
        ),
    ]


def _cpu(point: Point) -> NDArray[np.float64]:
    return point.frames.cpu


def _error(point: Point) -> NDArray[np.float64]:
    return point.live.frames.error


def _own(point: Point) -> NDArray[np.float64]:
    return point.frames.own


def _slipped(point: Point) -> NDArray[np.float64]:
    return point.frames.slipped


def _together(
    points: Sequence[Point], values: Callable[[Point], NDArray[np.float64]]
) -> NDArray[np.float64]:
    """The values of all frames that are known."""
    found = np.concatenate([values(p) for p in points]) if points else np.empty(0)
    return np.asarray(found[~np.isnan(found)])


def _fraction(what: str, asked: float, points: Sequence[Point], limit: float) -> Target:
    residual = _together(points, lambda p: p.frames.residual)
    seen = 100 * float((residual <= limit).mean()) if len(residual) else np.nan
    return Target.at_least(what, asked, seen, form=".4g")


def _most(
    what: str,
    limit: float,
    points: Sequence[Point],
    values: Callable[[Point], NDArray[np.float64]],
    percent: float,
    unit: str,
) -> Target:
    found = _together(points, values)
    seen = float(np.percentile(found, percent)) if len(found) else np.nan
    return Target.at_most(what, limit, seen, unit)


def _off(what: str, limit: float, points: Sequence[Point], percent: float) -> Target:
    """An error, where enough frames have one."""
    every = np.concatenate([_error(p) for p in points]) if points else np.empty(0)
    known = float(np.isfinite(every).mean()) if len(every) else 1.0
    if known < ENOUGH:
        seen = f"no converged answer for {100 * (1 - known):.0f} % of the frames"
        return Target(what, f"at most {limit:g} mm", seen)
    return _most(what, limit, points, _error, percent, "mm")


def _skipped(points: Sequence[Point]) -> float:
    """% of the poses of all motions."""
    came = sum(p.live.poses for p in points)
    return 100 * (1 - sum(len(p.live.frames.number) for p in points) / came) if came else np.nan


def _inverted(points: Sequence[Point]) -> float:
    frames = [each for p in points for each in (p.frames, p.live.frames)]
    return sum(int((each.inverted > 0).sum()) for each in frames) if frames else np.nan


def _rest(what: str, limit: int, points: Sequence[Point], residual: float) -> Target:
    """Frames after the probe has stopped; never, where a residual never is as small."""
    found = np.array([p.held.frames_to(residual) for p in points])
    never = int(np.isnan(found).sum())
    if not never:
        return Target.at_most(what, limit, found.max() if len(found) else np.nan, form="g")
    return Target(what, f"at most {limit}", f"never in {never} of {len(found)} motions", False)


_FRAME = 1e3 / RATE  # ms
_SHOWN = 4.0  # s, of a motion
_LOWEST = 1e-3  # mm; what is less is drawn there
_OF_HASTES = ("#9ecae1", "#3182bd", "#08306b")
_FAULTS: tuple[tuple[str, Callable[[Point], NDArray[np.bool_]]], ...] = (
    ("residual above 0.01", lambda p: p.frames.residual > 1e-2),
    ("residual above 0.1", lambda p: p.frames.residual > 0.1),
    ("residual above 1", lambda p: p.frames.residual > 1.0),
    ("tetrahedra inside out", lambda p: p.frames.inverted > 0),
    ("poses skipped at 60 Hz", lambda p: _poses_skipped(p)),
)


def plot_time(
    points: Sequence[Point],
    chosen: Sequence[Motion],
    answers: Mapping[Motion, Converged],
    file: Path,
) -> None:
    """A column a motion: the nodes' error over time, and what the hand does meanwhile."""
    figure = new_figure(
        *(4.4 * len(chosen) + 1.4, 7.2),
        "How far the farthest node is off while a hand moves (every pose fed)",
    )
    panels = figure.subplots(
        *(3, len(chosen)), squeeze=False, sharex="col", sharey="row", height_ratios=(2.4, 1, 1)
    )
    for (error, depth, speed), motion in zip(panels.T, chosen, strict=True):
        error.set_title(str(motion), fontsize=11, loc="left")
        for point in those(p for p in points if p.motion == motion):
            time = (point.frames.number - motion.begins) / RATE
            look = TISSUE_METHODS[point.method]
            shown = np.maximum(point.frames.error, _LOWEST)
            error.plot(time, shown, color=look.colour, lw=1.3, label=point.method)
            if not np.isnan(point.frames.own).all():
                some = ~np.isnan(point.frames.own)
                own = np.maximum(point.frames.own[some], _LOWEST)
                label = f"{point.method}, to its own balance"
                error.plot(time[some], own, ".", color=look.colour, ms=5, label=label)
        error.set_yscale("log")
        _draw_motion(depth, speed, motion, answers[motion])
        speed.set_xlabel("time, s")
        speed.set_xlim(0, min(_SHOWN, motion.duration))
        for panel in (error, depth, speed):
            plain(panel)
    panels[0, 0].set_ylim(bottom=_LOWEST)
    panels[0, 0].set_ylabel("error of the worst node, mm")
    panels[1, 0].set_ylabel("depth, mm")
    panels[2, 0].set_ylabel("speed", labelpad=8)
    panels[1, 0].invert_yaxis()
    key_beside(panels[0, -1])
    key_beside(panels[1, -1])
    key_beside(panels[2, -1])
    save(figure, file)


def plot_errors(points: Sequence[Point], chosen: Sequence[Motion], file: Path) -> None:
    """A panel a motion: error against processor time, the median and the 99th percentile."""
    columns = min(3, len(chosen))
    rows = -(-len(chosen) // columns)
    figure = new_figure(
        *(4.2 * columns + 1.6, 3.6 * rows + 0.7),
        "Error of the worst node against run time (full: median frame; hollow: 99th percentile)",
    )
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for panel, motion in zip(panels.flat, chosen, strict=False):
        panel.set_title(str(motion), fontsize=11, loc="left")
        for point in those(p for p in points if p.motion == motion):
            _draw_point(panel, point)
        panel.set(xscale="log", yscale="log")
        panel.axvline(_FRAME, color="0.6", lw=1, ls=":", zorder=0)
        plain(panel)
    for panel in panels.flat[len(chosen) :]:
        panel.set_visible(False)
    for panel in panels[:, 0]:
        panel.set_ylabel("error of the worst node, mm")
    for column in range(columns):
        lowest = max(row for row in range(rows) if panels[row, column].get_visible())
        panels[lowest, column].set_xlabel("processor time of a frame, ms")
        panels[lowest, column].tick_params(labelbottom=True)
    key_beside(panels[0, columns - 1], [*_key_of_methods(), _line("16.7 ms: 60 Hz", "0.6", ":")])
    save(figure, file)


def plot_faults(points: Sequence[Point], file: Path) -> None:
    """A panel a fault: in how many frames of a hundred a method has it, for each haste."""
    figure = new_figure(14.5, 4.2, "What goes wrong, in % of frames (all tissues and motions)")
    panels = figure.subplots(1, len(_FAULTS), sharey=True)
    hastes = [haste for haste in HASTES if those(points, haste=haste)]
    width = 0.8 / max(1, len(hastes))
    for panel, (title, faulty) in zip(panels, _FAULTS, strict=True):
        panel.set_title(title, fontsize=11, loc="left")
        for number, haste in enumerate(hastes):
            percent = [
                _percent_of_frames(those(points, method=m, haste=haste), faulty)
                for m in TISSUE_METHODS
            ]
            at = np.arange(len(percent)) + (number - 0.5 * (len(hastes) - 1)) * width
            colour = _OF_HASTES[list(HASTES).index(haste)]
            bars = panel.barh(at, percent, 0.92 * width, color=colour, label=_words_of(haste))
            panel.bar_label(bars, [f"{p:.3g}" for p in percent], padding=2, fontsize=7)
        panel.set_xlim(0, 118)
        plain(panel)
        panel.set_xticks([0, 50, 100])
    panels[0].set_yticks(range(len(TISSUE_METHODS)), list(TISSUE_METHODS))
    panels[0].invert_yaxis()
    panels[0].tick_params(axis="y", labelsize=10)
    key_beside(panels[-1])
    save(figure, file)


def plot_hold(points: Sequence[Point], file: Path) -> None:
    """A panel a method: the residual after the probe has stopped, a line a motion."""
    figure = new_figure(14.5, 4.2, "The probe is held still: does the tissue come to balance?")
    panels = figure.subplots(1, len(TISSUE_METHODS), sharex=True, sharey=True)
    for panel, method in zip(panels, TISSUE_METHODS, strict=True):
        panel.set_title(method, fontsize=11, loc="left")
        for point in those(points, method=method):
            residual, colour = point.held.residual, TISSUES[point.motion.tissue].colour
            shown = np.maximum(residual, 1e-9)
            # What has settled stays as it is.
            shown = np.append(shown, np.full(HOLD + 1 - len(shown), shown[-1]))
            bad = point.held.inverted > 0
            panel.plot(shown, color=colour, lw=1.2, ls="--" if bad else "-", alpha=0.8)
        panel.axhline(1e-3, color="0.4", lw=1, ls=":")
        panel.axvline(30, color="0.4", lw=1, ls=":")
        panel.set(yscale="log", xlim=(0, HOLD), ylim=(1e-9, None))
        plain(panel)
        panel.set_yticks(10.0 ** np.arange(-9, 4, 2), [f"$10^{{{n}}}$" for n in range(-9, 4, 2)])
        panel.set_xlabel("frames after it stopped")
    panels[0].set_ylabel("residual")
    names = dict.fromkeys(p.motion.tissue for p in points)
    key = [_line(name, TISSUES[name].colour, "-") for name in names]
    key += [_line("inside out at the end", "0.2", "--"), _line("asked: 0.001 in 30", "0.4", ":")]
    key_beside(panels[-1], key)
    save(figure, file)


def _draw_motion(depth: Axes, speed: Axes, motion: Motion, answer: Converged) -> None:
    poses = motion.poses[motion.begins :]
    time = np.arange(len(poses)) / RATE
    places = np.array([pose.position for pose in poses])
    turns = np.array([pose.orientation for pose in poses])
    depth.axhline(0.0, color="0.6", lw=1, label="skin")
    depth.plot(time, 1e3 * places[:, 2], color="0.2", lw=1.3, label="middle of the probe's face")
    touching = answer.pressed[motion.begins :]
    low, high = depth.get_ylim()
    depth.fill_between(
        *(time, low, high), where=touching.tolist(), color="0.93", zorder=0, label="touching"
    )
    moved = 1e3 * RATE * np.linalg.norm(np.diff(places, axis=0), axis=1)
    cosine = np.abs((turns[1:] * turns[:-1]).sum(axis=1)).clip(0.0, 1.0)
    speed.plot(time[1:], moved, color="0.2", lw=1.3, label="mm/s")
    turned = np.degrees(RATE * 2 * np.arccos(cosine))
    speed.plot(time[1:], turned, color="0.2", lw=1.0, ls="--", label="degrees/s")


def _draw_point(panel: Axes, point: Point) -> None:
    frames, look = point.frames, TISSUE_METHODS[point.method]
    if frames.compared < ENOUGH:
        return
    x = [float(np.percentile(frames.cpu, percent)) for percent in (50, 99)]
    y = [max(float(np.nanpercentile(frames.error, percent)), _LOWEST) for percent in (50, 99)]
    panel.plot(x, y, "-", color=look.colour, lw=1.2, alpha=0.7)
    panel.plot(x[0], y[0], look.mark, color=look.colour, ms=7)
    panel.plot(x[1], y[1], look.mark, mec=look.colour, mfc="white", ms=6)


def _key_of_methods() -> list[Any]:
    return [
        Line2D([], [], color=look.colour, marker=look.mark, lw=1.2, label=name)
        for name, look in TISSUE_METHODS.items()
    ]


def _line(label: str, colour: str, style: str) -> Line2D:
    return Line2D([], [], color=colour, ls=style, lw=1.3, label=label)


def _words_of(haste: str) -> str:
    asked = HASTES[haste]
    return f"{haste}: {1e3 * asked.speed:.0f} mm/s, {np.degrees(asked.turning):.0f}°/s"


def _poses_skipped(point: Point) -> NDArray[np.bool_]:
    seen = np.zeros(point.live.poses, dtype=np.bool_)
    seen[: len(point.live.frames.number)] = True
    return ~seen


def _percent_of_frames(
    points: Sequence[Point], faulty: Callable[[Point], NDArray[np.bool_]]
) -> float:
    found = [faulty(p) for p in points]
    return 100 * float(np.concatenate(found).mean()) if found else 0.0


def evaluate_hand(out: Path, quick: bool, settings: HandSettings | None = None) -> int:
    """Write hand.csv, the plots and hand.md, as `us_sim.evaluation` says.

    A quick run has fewer and shorter motions.
    """
    folder = ReportFolder("hand", out, quick)
    planned = motions(quick, (settings or HandSettings()).seed)
    answers: dict[Motion, Converged] = {}
    runs = sum(len(motion.poses) for motion in planned) * (1 + len(TISSUE_METHODS))
    with Progress("hand", runs, "poses") as progress, threadpool_limits(1):
        points = list(_points(planned, answers, progress.update))
        progress.update(runs)
    folder.write_rows("hand", points)
    write_report(folder, points, answers)
    return folder.finish(table(points), failures(points))
