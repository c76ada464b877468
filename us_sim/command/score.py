"""The command `score`: metrics of a recording as a table, CSV, and a page with a picture."""

from __future__ import annotations

import argparse
import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from us_sim.command.options import add_setting_options, read_settings
from us_sim.errors import ScoreError
from us_sim.progress import late_progress
from us_sim.scoring.exercise import Exercise, Step, read_exercise, result_of
from us_sim.scoring.metrics import Metric, Scan, metrics_of
from us_sim.scoring.picture import draw_score
from us_sim.scoring.settings import ScoreSettings
from us_sim.share import find_bag

_HEAD = ("MetricName", "MetricRoles", "MetricUnit", "MetricValue")
"""Columns of PerkTutor's tables."""
_FILES = ("score.csv", "score.png", "score.md")


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
        table = markdown_table((self.exercise.name, "done", "seen"), rows)
        return f"{table}\n\n{result_of([each.is_done for each in self.steps])}"

    def write(self, folder: Path) -> None:
        """Write table, picture and page into a folder."""
        with (folder / "score.csv").open("w", encoding="utf-8", newline="") as stream:
            rows = [(each.name, each.roles, each.unit, each.text) for each in self.metrics]
            csv.writer(stream, lineterminator="\n").writerows([_HEAD, *rows])
        draw_score(folder / "score.png", self.title, self.scan, self.steps)
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
