"""Pictures of error over time, of error against run time, of what goes wrong, and of the hold."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from us_sim.evaluation.figure import key_beside, new_figure, plain, save
from us_sim.evaluation.hand.cases import RATE, TISSUES, Motion
from us_sim.evaluation.hand.converged import Converged
from us_sim.evaluation.hand.points import ENOUGH, HOLD, Point, those
from us_sim.evaluation.tissue_methods import TISSUE_METHODS
from us_sim.recording.hand_motion import HASTES

_FRAME = 1e3 / RATE  # ms
_SHOWN = 4.0  # s, of a motion
_LOWEST = 1e-3  # mm; what is less is drawn there
_OF_HASTES = ("#9ecae1", "#3182bd", "#08306b")
_FAULTS: tuple[tuple[str, Callable[[Point], NDArray[np.bool_]]], ...] = (
    ("residual above 0.01", lambda p: p.frames.residual > 1e-2),
    ("residual above 0.1", lambda p: p.frames.residual > 0.1),
    ("residual above 1", lambda p: p.frames.residual > 1.0),
    ("tetrahedra inside out", lambda p: p.frames.inverted > 0),
    ("poses skipped at 60 Hz", lambda p: _skipped(p)),
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
                _percent(those(points, method=m, haste=haste), faulty) for m in TISSUE_METHODS
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


def _skipped(point: Point) -> NDArray[np.bool_]:
    seen = np.zeros(point.live.poses, dtype=np.bool_)
    seen[: len(point.live.frames.number)] = True
    return ~seen


def _percent(points: Sequence[Point], faulty: Callable[[Point], NDArray[np.bool_]]) -> float:
    found = [faulty(p) for p in points]
    return 100 * float(np.concatenate(found).mean()) if found else 0.0
