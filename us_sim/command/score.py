"""The command `score`: metrics of a recording as a table, CSV, and a page with a picture."""

from __future__ import annotations

import argparse
import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from us_sim.command.options import add_setting_options, read_settings
from us_sim.errors import ScoreError
from us_sim.progress import late_progress
from us_sim.scoring.exercise import Exercise, Step, read_exercise
from us_sim.scoring.metrics import Metric, Scan, metrics_of
from us_sim.scoring.settings import ScoreSettings
from us_sim.share import find_bag

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_HEAD = ("MetricName", "MetricRoles", "MetricUnit", "MetricValue")
"""Columns of PerkTutor's tables."""
_FILES = ("score.csv", "score.png", "score.md")
_MM = 1e3


def score_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "session",
        type=find_bag,
        metavar="SESSION",
        help="a session, any bag with poses, or a recording of Plus or 3D Slicer",
    )
    parser.add_argument("--topic", metavar="NAME", help="of the poses, where there are several")
    parser.add_argument("--wrench", metavar="NAME", help="topic of the force on the probe")
    parser.add_argument(
        "--exercise", metavar="NAME", help="file of an exercise, or name of an installed one"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help=f"write {', '.join(_FILES)} there")
    add_setting_options(parser, ScoreSettings)
    parser.set_defaults(command=_score)


def _score(args: argparse.Namespace) -> int:
    from us_sim.run.session_score import read_scan

    settings = read_settings(args, ScoreSettings)
    exercise = read_exercise(args.exercise) if args.exercise is not None else None
    out: Path | None = args.out
    taken = [out / file for file in _FILES if (out / file).exists()] if out is not None else []
    if taken:
        raise ScoreError(f"{taken[0]} exists already: choose another folder with --out")
    scan = read_scan(args.session, args.topic, args.wrench, late_progress("score"))
    steps = exercise.steps(scan) if exercise is not None else []
    score = Score(args.session.name, list(metrics_of(scan, settings)), scan, exercise, steps)
    print(score.table())
    for sentence in scan.missing:
        print(f"left out: {sentence}")
    if exercise is not None:
        print(score.exercise_table())
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        score.write(out)
        print(out / "score.md")
    return 0


@dataclass(frozen=True)
class Score:
    """The metrics of one recording, what was done of an exercise, and their page."""

    title: str
    metrics: Sequence[Metric]
    scan: Scan
    exercise: Exercise | None = None
    steps: Sequence[Step] = ()

    def table(self) -> str:
        """For a terminal, and for a page."""
        from us_sim.evaluation.report import markdown_table

        rows = [(each.name, each.text, each.unit, each.roles) for each in self.metrics]
        return markdown_table(("metric", "value", "unit", "roles"), rows)

    def exercise_table(self) -> str:
        """Steps of the exercise, whether each is done, what was seen of it; then the result."""
        from us_sim.evaluation.report import markdown_table

        assert self.exercise is not None
        rows = [(each.what, "yes" if each.is_done else "no", each.seen) for each in self.steps]
        done = sum(each.is_done for each in self.steps)
        result = "passed" if done == len(self.steps) else "not passed"
        table = markdown_table((self.exercise.name, "done", "seen"), rows)
        return f"{table}\n\n{result}: {done} of {len(rows)} done"

    def write(self, folder: Path) -> None:
        """Write table, picture and page into a folder."""
        with (folder / "score.csv").open("w", encoding="utf-8", newline="") as stream:
            rows = [(each.name, each.roles, each.unit, each.text) for each in self.metrics]
            csv.writer(stream, lineterminator="\n").writerows([_HEAD, *rows])
        self._draw(folder / "score.png")
        missing = [f"- Left out: {sentence}." for sentence in self.scan.missing]
        parts = [
            f"# Score of {self.title}",
            self.exercise.description if self.exercise else "",
            self.exercise_table() if self.exercise else "",
            self.table(),
            "\n".join(missing),
            "![The probe's way over the skin; force and areas over time](score.png)",
            "The values are in [score.csv](score.csv), too; `docs/scores.md` defines them.",
        ]
        text = "\n\n".join(filter(None, parts)) + "\n"
        (folder / "score.md").write_text(text, encoding="utf-8")

    def _draw(self, file: Path) -> None:
        """The way over the skin at the left; force and areas over time at the right."""
        from us_sim.evaluation.report import picture, plain

        force, sections = self.scan.force, self.scan.sections
        over_time = [self._draw_force] * (force is not None) + [self._draw_areas] * bool(sections)
        over_time = over_time or [self._draw_speed]
        with picture(file, 11, 5.2, self.title) as figure:
            grid = figure.add_gridspec(len(over_time), 2, width_ratios=(1, 1.4))
            self._draw_way(figure.add_subplot(grid[:, 0]))
            first: Axes | None = None
            for row, draw in enumerate(over_time):
                axes = figure.add_subplot(grid[row, 1], sharex=first)
                first = first or axes
                draw(axes)
                plain(axes)
            axes.set_xlabel("s since the first pose")

    def _draw_way(self, axes: Axes) -> None:
        from us_sim.evaluation.report import plain

        motion, force = self.scan.motion, self.scan.force
        x, y = _MM * motion.positions[:, :2].T
        axes.plot(x, y, color="0.8", lw=1, zorder=1)
        if force is None:
            axes.plot(x, y, color="C0", lw=1.2, zorder=2)
        else:
            newtons = force.at(motion.times)
            upwards = np.argsort(newtons)  # the strongest on top
            shown = axes.scatter(x[upwards], y[upwards], 9, newtons[upwards], cmap="viridis")
            axes.figure.colorbar(shown, ax=axes, label="force, N", shrink=0.7)
        for name, line in self.scan.lines.items():
            way = _MM * line.points[:, :2].T
            axes.plot(*way, color=_colour(name), lw=3, alpha=0.5, label=name, zorder=0)
        for step in self.steps:
            if step.target is not None:
                x, y = _MM * step.target[:2]
                axes.scatter(x, y, 150, "none", lw=2, edgecolors="C2" if step.is_done else "C3")
        if self.scan.lines:
            axes.legend(fontsize=8, frameon=False)
        axes.set(xlabel="x, mm", ylabel="y, mm", title="Way of the probe's face over the skin")
        axes.set_aspect("equal", adjustable="datalim")
        plain(axes)

    def _draw_force(self, axes: Axes) -> None:
        assert self.scan.force is not None
        axes.plot(self.scan.force.times, self.scan.force.newtons, lw=1)
        axes.set_ylabel("force, N")

    def _draw_areas(self, axes: Axes) -> None:
        for name, section in self.scan.sections.items():
            label = f"{name}, % of its area at rest"
            axes.plot(section.times, 100 * section.fraction, color=_colour(name), label=label)
        axes.set_ylim(bottom=0)
        axes.legend(fontsize=8, frameon=False)

    def _draw_speed(self, axes: Axes) -> None:
        axes.plot(self.scan.motion.times[1:], _MM * self.scan.motion.speeds, lw=1)
        axes.set_ylabel("speed, mm/s")


def _colour(name: str) -> tuple[float, float, float]:
    from us_sim.volume.structure_names import anatomical_colour

    return anatomical_colour(name)
