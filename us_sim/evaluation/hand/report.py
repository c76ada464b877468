"""`us-sim evaluate hand`: hand.csv, its pictures, and hand.md."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from us_sim.evaluation.hand.hand_motion import HASTES, KINDS, RATE
from us_sim.evaluation.hand.measure import (
    APPROACH,
    AWAY,
    CONVERGED,
    ENOUGH,
    HELD,
    HOLD,
    MAIN_TISSUE,
    OWN_EVERY,
    TISSUES,
    TRUSTED,
    Converged,
    Motion,
    Point,
    measured_points,
    motions,
    select,
)
from us_sim.evaluation.report import (
    ReportFolder,
    Target,
    failures,
    key_beside,
    markdown_table,
    method_keys,
    number,
    panel_grid,
    percentile,
    picture,
    plain,
    target_table,
)
from us_sim.evaluation.settings import HandSettings
from us_sim.evaluation.tissue_methods import TISSUE_METHODS
from us_sim.progress import Progress

JUDGED = "fem_nonlinear"  # the method that the targets are for

_LOWEST = 1e-3  # mm; smaller errors are drawn there
_HEAD = (
    *("mm, p50", "p95", "p99", "worst", "to own balance: mm, p50", "worst"),
    *("residual, p50", "p99", "> 0.01", "> 0.1", "> 1"),
    *("inverted", "ms, p50", "p99", "worst"),
)
_LIVE = (
    *("poses", "skipped", "mm, p50", "worst", "ms off", "latency ms, p50", "p99", "inverted"),
    *("held: frames to 0.01", "to 0.001", "residual in the end", "inverted then"),
)


def evaluate_hand(out: Path, quick: bool, settings: HandSettings | None = None) -> int:
    """Write hand.csv, the plots and hand.md, as `us_sim.evaluation` says.

    A quick run has fewer and shorter motions.
    """
    folder = ReportFolder("hand", out, quick)
    planned = motions(quick, (settings or HandSettings()).seed)
    answers: dict[Motion, Converged] = {}
    runs = sum(len(motion.poses) for motion in planned) * (1 + len(TISSUE_METHODS))
    with Progress("hand", runs, "poses") as progress, threadpool_limits(1):
        points = list(measured_points(planned, answers, progress.update))
        progress.update(runs)
    folder.write_rows("hand", points)
    table = target_table(targets(points))
    free = [motion for motion in answers if motion.kind == "free"]
    others = [motion for motion in answers if motion.kind != "free"]
    main = [motion for motion in free if motion.tissue == MAIN_TISSUE]
    rest = [motion for motion in (*free, *others) if motion not in main]
    rest.sort(key=lambda motion: motion.tissue == MAIN_TISSUE)  # one of another tissue first
    _plot_time(points, [*main, *rest][:3], answers, folder.picture("time"))
    _plot_errors(points, list(answers) if folder.quick else free, folder.picture("error"))
    _plot_faults(points, folder.picture("faults"))
    _plot_hold(points, folder.picture("hold"))
    hastes = "; ".join(
        f"{name}: {1e3 * asked.speed:.0f} mm/s and {np.degrees(asked.turning):.0f}°/s"
        for name, asked in HASTES.items()
    )
    return folder.finish(
        table,
        failures(points),
        ("numpy", "scipy", "numba"),
        hastes=hastes,
        seeds=", ".join(dict.fromkeys(str(motion.seed) for motion in answers)),
        rate=f"{RATE:.0f}",
        judged=JUDGED,
        targets=table,
        motions=_by_motion(select(points, kind=None if folder.quick else "free")),
        live=_live(select(points)),
        hold=f"{HOLD}",
        tissues="\n".join(f"- `{name}`: {tissue.words}" for name, tissue in TISSUES.items()),
        kinds="\n".join(f"- {name}: {kind.words}" for name, kind in KINDS.items()),
        answers=_answers(answers),
        away=f"{AWAY:g}",
        converged=f"{CONVERGED:g}",
        trusted=f"{TRUSTED:g}",
        held=f"{1e3 * HELD:g}",
        few=f"{100 * (1 - ENOUGH):.0f}",
        own_every=f"{OWN_EVERY}",
        approach=f"{APPROACH:g}",
    )


def targets(points: Sequence[Point]) -> list[Target]:
    """Limits for `JUDGED`, against the measured numbers."""
    mine = select(points, method=JUDGED)
    brisk = select(mine, tissue=MAIN_TISSUE, haste="brisk")
    careful = select(mine, tissue=MAIN_TISSUE, haste="careful")
    violent = select(mine, haste="violent")
    where = f"brisk on the {MAIN_TISSUE}"

    def most(
        what: str, limit: float, some: Sequence[Point], values: _Values, percent: float, unit: str
    ) -> Target:
        found = _together(some, values)
        return Target.at_most(what, limit, percentile(found[~np.isnan(found)], percent), unit)

    def fraction(what: str, asked: float, some: Sequence[Point], limit: float) -> Target:
        residual = _together(some, lambda p: p.frames.residual)
        seen = 100 * float((residual <= limit).mean()) if len(residual) else np.nan
        return Target.at_least(what, asked, seen, form=".4g")

    def off(what: str, limit: float, unit: str, seen: float) -> Target:
        """A measure of errors, where enough frames have one."""
        known = float(np.isfinite(errors).mean()) if len(errors) else 1.0
        if known < ENOUGH:
            said = f"no converged answer for {100 * (1 - known):.0f} % of the frames"
            return Target(what, f"at most {limit:g} {unit}", said)
        return Target.at_most(what, limit, seen, unit)

    def rest(what: str, limit: int, some: Sequence[Point], residual: float) -> Target:
        """Frames after the probe has stopped until the residual is as small."""
        found = np.array([p.held.frames_to(residual) for p in some])
        never = int(np.isnan(found).sum())
        if not never:
            return Target.at_most(what, limit, found.max() if len(found) else np.nan, form="g")
        return Target(what, f"at most {limit}", f"never in {never} of {len(found)} motions", False)

    errors = _together(brisk, lambda p: p.live.frames.error)
    live_error = percentile(errors[~np.isnan(errors)], 50)
    away = max((p.live.away for p in brisk), default=np.nan)
    came = sum(p.live.poses for p in brisk)
    made = sum(len(p.live.frames.number) for p in brisk)
    inverted = sum(
        int((each.inverted > 0).sum()) for p in mine for each in (p.frames, p.live.frames)
    )
    inverted_at_rest = sum(p.held.inverted > 0 for p in mine)
    return [
        fraction(f"{where}: % of frames with a residual of at most 0.01", 99.0, brisk, 1e-2),
        fraction(f"{where}: likewise 0.1", 100.0, brisk, 0.1),
        most(f"{where}: ms a frame (processor), median", 8, brisk, _cpu, 50, "ms"),
        most(f"{where}: likewise, 99th percentile", 33, brisk, _cpu, 99, "ms"),
        most(f"{where}: mm to its own balance, median", 0.05, brisk, _own, 50, "mm"),
        most(f"{where}: likewise, 99th percentile", 0.5, brisk, _own, 99, "mm"),
        fraction(f"careful on the {MAIN_TISSUE}: % with at most 0.01", 99.9, careful, 1e-2),
        off(f"live, {where}: mm to the converged answer, median", 0.05, "mm", live_error),
        off(f"live, {where}: ms in which a node is over {AWAY:g} mm off, longest", 50, "ms", away),
        most(
            *(f"live, {where}: ms from a pose to its nodes, 99th percentile", 25, brisk),
            *(lambda p: p.live.latency, 99, "ms"),
        ),
        Target.at_most(
            f"live, {where}: % of poses skipped", 5, 100 * (1 - made / came) if came else np.nan
        ),
        Target.at_most(
            "all motions: frames with inverted tetrahedra", 0, inverted if mine else np.nan
        ),
        most("violent: ms of the slowest frame", 50, violent, lambda p: p.frames.wall, 100, "ms"),
        most(
            "all motions: mm that a fixed node moves",
            0,
            mine,
            lambda p: p.frames.slipped,
            100,
            "mm",
        ),
        rest("violent, then held: frames to a residual of 0.01, worst", 5, violent, 1e-2),
        rest("all motions, then held: frames to a residual of 0.001, worst", 30, mine, 1e-3),
        Target.at_most(
            "all motions, then held: inverted in the end", 0, inverted_at_rest if mine else np.nan
        ),
    ]


_Values = Callable[[Point], NDArray[np.float64]]


def _cpu(point: Point) -> NDArray[np.float64]:
    return point.frames.cpu


def _own(point: Point) -> NDArray[np.float64]:
    return point.frames.own


def _together(points: Sequence[Point], values: Callable[[Point], NDArray]) -> NDArray:
    return np.concatenate([values(p) for p in points]) if points else np.empty(0)


def _plot_time(
    points: Sequence[Point],
    chosen: Sequence[Motion],
    answers: Mapping[Motion, Converged],
    file: Path,
) -> None:
    """A column a motion: the nodes' error over time, and the depth and speed of the hand."""
    title = "How far the farthest node is off while a hand moves (every pose fed)"
    with picture(file, 4.4 * len(chosen) + 1.4, 7.2, title) as figure:
        panels = figure.subplots(
            *(3, len(chosen)), squeeze=False, sharex="col", sharey="row", height_ratios=(2.4, 1, 1)
        )
        for (error, depth, speed), motion in zip(panels.T, chosen, strict=True):
            error.set_title(str(motion), fontsize=11, loc="left")
            for point in select(p for p in points if p.motion == motion):
                time = (point.frames.number - motion.begins) / RATE
                colour = TISSUE_METHODS[point.method].colour
                shown = np.maximum(point.frames.error, _LOWEST)
                error.plot(time, shown, color=colour, lw=1.3, label=point.method)
                some = ~np.isnan(point.frames.own)
                if some.any():
                    own = np.maximum(point.frames.own[some], _LOWEST)
                    label = f"{point.method}, to its own balance"
                    error.plot(time[some], own, ".", color=colour, ms=5, label=label)
            error.set_yscale("log")
            _draw_motion(depth, speed, motion, answers[motion])
            speed.set_xlabel("time, s")
            speed.set_xlim(0, min(4.0, motion.duration))
            for panel in (error, depth, speed):
                plain(panel)
        panels[0, 0].set_ylim(bottom=_LOWEST)
        panels[0, 0].set_ylabel("error of the worst node, mm")
        panels[1, 0].set_ylabel("depth, mm")
        panels[2, 0].set_ylabel("speed", labelpad=8)
        panels[1, 0].invert_yaxis()
        for panel in panels[:, -1]:
            key_beside(panel)


def _draw_motion(depth: Axes, speed: Axes, motion: Motion, answer: Converged) -> None:
    depths = np.array([pose.position[2] for pose in motion.poses[motion.begins :]])
    time = np.arange(len(depths)) / RATE
    depth.axhline(0.0, color="0.6", lw=1, label="skin")
    depth.plot(time, 1e3 * depths, color="0.2", lw=1.3, label="middle of the probe's face")
    touching = answer.pressed[motion.begins :].tolist()
    look = {"color": "0.93", "zorder": 0, "label": "touching"}
    depth.fill_between(time, *depth.get_ylim(), where=touching, **look)  # type: ignore[arg-type]
    moved, turned = motion.speeds
    speed.plot(time[1:], 1e3 * moved, color="0.2", lw=1.3, label="mm/s")
    speed.plot(time[1:], np.degrees(turned), color="0.2", lw=1.0, ls="--", label="degrees/s")


def _plot_errors(points: Sequence[Point], chosen: Sequence[Motion], file: Path) -> None:
    """A panel a motion: error against processor time, the median and the 99th percentile."""
    columns, rows = min(3, len(chosen)), -(-len(chosen) // 3)
    title = "Error of the worst node against run time (full: median frame; hollow: 99th percentile)"
    labels = ("processor time of a frame, ms", "error of the worst node, mm")
    with picture(file, 4.2 * columns + 1.6, 3.6 * rows + 0.7, title) as figure:
        panels = panel_grid(figure, map(str, chosen), *labels)
        for panel, motion in zip(panels, chosen, strict=True):
            for point in select(p for p in points if p.motion == motion):
                frames, look = point.frames, TISSUE_METHODS[point.method]
                if frames.compared >= ENOUGH:
                    x = [float(np.percentile(frames.cpu, part)) for part in (50, 99)]
                    y = [float(np.nanpercentile(frames.error, part)) for part in (50, 99)]
                    y = [max(value, _LOWEST) for value in y]
                    panel.plot(x, y, "-", color=look.colour, lw=1.2, alpha=0.7)
                    panel.plot(x[0], y[0], look.mark, color=look.colour, ms=7)
                    panel.plot(x[1], y[1], look.mark, mec=look.colour, mfc="white", ms=6)
            panel.set(xscale="log", yscale="log")
            panel.axvline(1e3 / RATE, color="0.6", lw=1, ls=":", zorder=0)
            plain(panel)
        key = method_keys(TISSUE_METHODS, lw=1.2)
        key_beside(panels[columns - 1], [*key, _line("16.7 ms: 60 Hz", "0.6", ":")])


def _plot_faults(points: Sequence[Point], file: Path) -> None:
    """A panel a fault: in how many frames of a hundred a method has it, for each haste."""
    faults: dict[str, Callable[[Point], NDArray[np.bool_]]] = {
        "residual above 0.01": lambda p: p.frames.residual > 1e-2,
        "residual above 0.1": lambda p: p.frames.residual > 0.1,
        "residual above 1": lambda p: p.frames.residual > 1.0,
        "tetrahedra inside out": lambda p: p.frames.inverted > 0,
        "poses skipped at 60 Hz": lambda p: np.arange(p.live.poses) >= len(p.live.frames.number),
    }
    hastes = [haste for haste in HASTES if select(points, haste=haste)]
    width = 0.8 / max(1, len(hastes))
    title = "What goes wrong, in % of frames (all tissues and motions)"
    with picture(file, 14.5, 4.2, title) as figure:
        panels = figure.subplots(1, len(faults), sharey=True)
        for panel, (name, faulty) in zip(panels, faults.items(), strict=True):
            panel.set_title(name, fontsize=11, loc="left")
            for place, haste in enumerate(hastes):
                percent = []
                for method in TISSUE_METHODS:
                    found = _together(select(points, method=method, haste=haste), faulty)
                    percent.append(100 * float(found.mean()) if len(found) else 0.0)
                at = np.arange(len(percent)) + (place - 0.5 * (len(hastes) - 1)) * width
                colour = dict(zip(HASTES, ("#9ecae1", "#3182bd", "#08306b"), strict=True))[haste]
                asked = HASTES[haste]
                label = f"{haste}: {1e3 * asked.speed:.0f} mm/s, {np.degrees(asked.turning):.0f}°/s"
                bars = panel.barh(at, percent, 0.92 * width, color=colour, label=label)
                panel.bar_label(bars, [f"{p:.3g}" for p in percent], padding=2, fontsize=7)
            panel.set_xlim(0, 118)
            plain(panel)
            panel.set_xticks([0, 50, 100])
        panels[0].set_yticks(range(len(TISSUE_METHODS)), list(TISSUE_METHODS))
        panels[0].invert_yaxis()
        panels[0].tick_params(axis="y", labelsize=10)
        key_beside(panels[-1])


def _plot_hold(points: Sequence[Point], file: Path) -> None:
    """A panel a method: the residual after the probe has stopped, a line a motion."""
    with picture(
        file, 14.5, 4.2, "The probe is held still: does the tissue come to balance?"
    ) as figure:
        panels = figure.subplots(1, len(TISSUE_METHODS), sharex=True, sharey=True)
        for panel, method in zip(panels, TISSUE_METHODS, strict=True):
            panel.set_title(method, fontsize=11, loc="left")
            for point in select(points, method=method):
                shown = np.maximum(point.held.residual, 1e-9)
                # A settled residual stays.
                shown = np.append(shown, np.full(HOLD + 1 - len(shown), shown[-1]))
                style = "--" if point.held.inverted > 0 else "-"
                colour = TISSUES[point.motion.tissue].colour
                panel.plot(shown, color=colour, lw=1.2, ls=style, alpha=0.8)
            panel.axhline(1e-3, color="0.4", lw=1, ls=":")
            panel.axvline(30, color="0.4", lw=1, ls=":")
            panel.set(yscale="log", xlim=(0, HOLD), ylim=(1e-9, None))
            plain(panel)
            ticks = range(-9, 4, 2)
            panel.set_yticks([10.0**n for n in ticks], [f"$10^{{{n}}}$" for n in ticks])
            panel.set_xlabel("frames after it stopped")
        panels[0].set_ylabel("residual")
        names = dict.fromkeys(p.motion.tissue for p in points)
        key = [_line(name, TISSUES[name].colour, "-") for name in names]
        key += [_line("inside out at the end", "0.2", "--")]
        key_beside(panels[-1], [*key, _line("asked: 0.001 in 30", "0.4", ":")])


def _line(label: str, colour: str, style: str) -> Line2D:
    return Line2D([], [], color=colour, ls=style, lw=1.3, label=label)


def _by_motion(points: Sequence[Point]) -> str:
    rows = []
    for p in points:
        values = p.values
        told = p.frames.compared >= ENOUGH
        errors = [values[f"error_mm_{part}"] for part in ("p50", "p95", "p99", "worst")]
        numbers = [
            *(errors if told else 4 * [np.nan]),
            *(values[f"own_error_mm_{part}"] for part in ("p50", "worst")),
            *(values[f"residual_{part}"] for part in ("p50", "p99")),
        ]
        rows.append(
            (
                *(str(p.motion), _name(p.method), *map(_number, numbers)),
                *(_percent(values[f"residual_over_{limit}"]) for limit in ("0.01", "0.1", "1")),
                f"{values['frames_inverted']}",
                *(_number(values[f"cpu_ms_{part}"]) for part in ("p50", "p99", "worst")),
            )
        )
    return markdown_table(("motion", "method", *_HEAD), rows)


def _live(points: Sequence[Point]) -> str:
    rows = []
    for p in points:
        values, told = p.values, p.live.frames.compared >= ENOUGH
        errors = [values[f"live_{name}"] for name in ("error_mm_p50", "error_mm_worst", "away_ms")]
        rows.append(
            (
                *(str(p.motion), _name(p.method), f"{p.live.poses}"),
                _percent(values["live_skipped"]),
                *(_number(error) if told else "" for error in errors),
                *(_number(values[f"live_latency_ms_{part}"]) for part in ("p50", "p99")),
                f"{values['live_frames_inverted']}",
                *(number(p.held.frames_to(small), ".0f", "never") for small in (1e-2, 1e-3)),
                _number(values["hold_residual"]),
                "yes" if p.held.inverted else "",
            )
        )
    return markdown_table(("motion", "method", *_LIVE), rows)


def _answers(answers: Mapping[Motion, Converged]) -> str:
    rows = [
        (
            *(str(motion), f"{len(answer.residual)}"),
            *map(_percent, ((answer.residual <= CONVERGED).mean(), answer.trusted.mean())),
            *map(_number, (answer.residual.max(), answer.smallest.min())),
            _number(1e3 * answer.slipped.max()),
        )
        for motion, answer in answers.items()
    ]
    head = ("motion", "poses", f"residual ≤ {CONVERGED:g}", f"≤ {TRUSTED:g}", "largest residual")
    return markdown_table((*head, "smallest volume ratio", "mm a fixed node moved"), rows)


def _name(method: str) -> str:
    return f"**{method}**" if method == JUDGED else method


def _number(value: Any) -> str:
    return number(value, ".2g")


def _percent(value: Any) -> str:
    return f"{100 * value:.3g} %" if np.isfinite(value) else ""
