"""The command `us-sim score`: metrics of a recording as a table, CSV, and a page with a picture."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from us_sim.command.options import add_setting_options, read_settings
from us_sim.errors import ScoreError
from us_sim.progress import late_progress
from us_sim.scoring.exercise import Exercise, Step, read_exercise
from us_sim.scoring.metrics import Metric, Tally
from us_sim.scoring.picture import draw_score
from us_sim.scoring.settings import ScoreSettings
from us_sim.share import find_bag

_HEAD = ("MetricName", "MetricRoles", "MetricUnit", "MetricValue")
"""Columns of PerkTutor's tables."""
_FILES = ("score.csv", "score.png", "score.md")


def score_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `us-sim score`."""
    parser.add_argument(
        "session",
        type=find_bag,
        nargs="?",
        metavar="SESSION",
        help="a session, any bag with poses, or a recording of Plus or 3D Slicer",
    )
    parser.add_argument(
        "--class",
        dest="of_class",
        metavar="ADDRESS",
        help="in place of a session: one table of all results of `us-sim view --results ADDRESS`",
    )
    parser.add_argument("--topic", metavar="NAME", help="of the poses, where there are several")
    parser.add_argument("--wrench", metavar="NAME", help="topic of the force on the probe")
    parser.add_argument(
        "--exercise", metavar="NAME", help="file of an exercise, or name of an installed one"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help=f"write {', '.join(_FILES)} there")
    add_setting_options(parser, ScoreSettings)
    parser.set_defaults(command=_score)


def _require_new(out: Path | None, files: Sequence[str]) -> None:
    old = [out / file for file in files if (out / file).exists()] if out is not None else []
    if old:
        raise ScoreError(f"{old[0]} exists already: choose another folder with --out")


def _score_class(args: argparse.Namespace) -> int:
    from us_sim.scoring.class_table import CLASS_FILES, tabulate_results, write_class_table
    from us_sim.scoring.result_place import read_results

    _require_new(args.out, CLASS_FILES)
    table = tabulate_results(read_results(args.of_class))
    print(table.loc[:, :"arm"].to_string(index=False))
    for file in write_class_table(table, args.out) if args.out is not None else []:
        print(file)
    return 0


def _score(args: argparse.Namespace) -> int:
    from us_sim.evaluation.report import format_markdown_table
    from us_sim.run.session_score import read_scan

    if (args.session is None) == (args.of_class is None):
        raise ScoreError("name a session to score, or the results of a class with --class")
    if args.of_class is not None:
        return _score_class(args)
    settings = read_settings(args, ScoreSettings)
    exercise = read_exercise(args.exercise) if args.exercise is not None else None
    out: Path | None = args.out
    _require_new(out, _FILES)
    scan = read_scan(args.session, args.topic, args.wrench, late_progress("score"))
    metrics = list(Tally(settings).add_scan(scan).list_metrics())
    rows = [(each.name, each.format(), each.unit, _format_roles(each)) for each in metrics]
    table = format_markdown_table(("metric", "value", "unit", "roles"), rows)
    missing = [f"left out: {sentence}" for sentence in scan.missing]
    steps = []
    if exercise is not None:
        attempt = exercise.begin_attempt(scan.lines)
        attempt.add_scan(scan)
        steps = attempt.list_steps()
    done = _tabulate_steps(exercise, steps) if exercise is not None else ""
    print("\n".join(filter(None, [table, *missing, done])))
    if out is None:
        return 0
    out.mkdir(parents=True, exist_ok=True)
    values = [(each.name, _format_roles(each), each.unit, each.format()) for each in metrics]
    pd.DataFrame(values, columns=_HEAD).to_csv(out / "score.csv", index=False)
    draw_score(out / "score.png", args.session.name, scan, steps)
    page = [
        f"# Score of {args.session.name}",
        exercise.description if exercise is not None else "",
        done,
        table,
        "\n".join(f"- {sentence}." for sentence in missing),
        "![The probe's way over the skin; force and areas over time](score.png)",
        "The values are in [score.csv](score.csv), too; `docs/scores.md` defines them.",
    ]
    text = "\n\n".join(filter(None, page)) + "\n"
    (out / "score.md").write_text(text, encoding="utf-8")
    print(out / "score.md")
    return 0


def _format_roles(metric: Metric) -> str:
    """Return the objects that a metric is of, as PerkTutor writes them."""
    return f"Any = Probe, Structure = {metric.structure}" if metric.structure else "Any = Probe"


def _tabulate_steps(exercise: Exercise, steps: Sequence[Step]) -> str:
    """Make a table of an exercise's steps, done or not, with the evidence; then the result."""
    from us_sim.evaluation.report import format_markdown_table

    rows = [(each.what, "yes" if each.is_done else "no", each.seen) for each in steps]
    table = format_markdown_table((exercise.name, "done", "seen"), rows)
    done = sum(each.is_done for each in steps)
    result = "passed" if done == len(steps) else "not passed"
    return f"{table}\n\n{result}: {done} of {len(steps)} done"
