"""The table of a class: all results that were written to one place, and a picture of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import pandas as pd

from us_sim.scoring.result import encode_picture

CLASS_FILES = ("class.csv", "class.html")
_CHECKSUMS = ("checksum", "scene checksum")
_ABOUT = ("moved by", "others", "arm", "volume", "method", "changed", *_CHECKSUMS)
_ALT = "Points right of each attempt, over time, for each student"


def tabulate_results(results: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Return one row for each result: who, what, when, what became of it, and plain metrics.

    Checksums that most students of the exercise do not have are marked.
    """
    rows = [
        {
            "student": each["about"].get("student") or "somebody",
            "exercise": each["name"],
            "begun": each["about"]["begun"],
            "result": each["state"],
            **dict([*each["plain"].items()][:-1]),  # the last is told in two columns
            "right": sum(step["state"] == "done" for step in each["steps"]),
            "of": len(each["steps"]),
            "faults": len(each["faults"]),
            **{key: each["about"].get(key, "") for key in _ABOUT},
        }
        for each in results
    ]
    table = pd.DataFrame(rows)
    for key in _CHECKSUMS:
        votes = table.drop_duplicates(["student", "exercise", key]).groupby("exercise")[key]
        most = table["exercise"].map(votes.agg(lambda each: each.mode().iloc[0]))
        table[key] = table[key].where(table[key] == most, table[key] + ", unlike most")
    return table


def write_class_table(table: pd.DataFrame, folder: Path) -> list[Path]:
    """Write the table as CSV, and as a page with a picture; return the files."""
    files = [folder / name for name in CLASS_FILES]
    folder.mkdir(parents=True, exist_ok=True)
    table.to_csv(files[0], index=False)
    shown = table.drop(columns=["volume"]).fillna("-")
    students, exercises = table["student"].nunique(), table["exercise"].nunique()
    passed = (table["result"] == "passed").sum()
    files[1].write_text(
        '<!DOCTYPE html><html lang="en"><meta charset="utf-8"><title>Class</title>'
        "<style>body {font-family: sans-serif; margin: 2em} td, th {padding: 0.2em 0.8em; "
        "text-align: left} img {max-width: 100%}</style><h1>Class</h1>"
        f"<p>{students} students, {exercises} exercises, {len(table)} attempts, {passed} of them "
        f'passed.</p><img src="{encode_picture(_draw(table))}" alt="{_ALT}">'
        f"{shown.to_html(index=False, border=0)}</html>",
        encoding="utf-8",
    )
    return files


def _draw(table: pd.DataFrame) -> bytes:
    """Draw the part of the points that is right over time: a row for each exercise."""
    from matplotlib.figure import Figure

    exercises = list(dict.fromkeys(table["exercise"]))
    figure = Figure(figsize=(9, 1.0 + 1.8 * len(exercises)), dpi=100, layout="constrained")
    grid = figure.subplots(len(exercises), 1, sharex=True, squeeze=False)
    times = pd.to_datetime(table["begun"], utc=True)
    part = 100 * table["right"] / table["of"].clip(lower=1)
    for axes, exercise in zip(grid[:, 0], exercises, strict=True):
        for student, all_of_one in table.groupby("student"):
            mine = all_of_one.index[all_of_one["exercise"] == exercise]
            axes.plot(times[mine], part[mine], "o-", label=student)
        axes.set(title=exercise, ylabel="right, %", ylim=(-5, 105))
        axes.grid(True, color="0.93")
        axes.spines[["top", "right"]].set_visible(False)
    grid[0, 0].legend(fontsize=8, frameon=False)
    figure.autofmt_xdate()
    drawn = BytesIO()
    figure.savefig(drawn, format="png")
    return drawn.getvalue()
