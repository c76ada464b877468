"""The result of an attempt: a document for programs, and a page for people.

The document has `name`, `description`, `scene`, `state` (of `STATES`), `seconds`, and

- `about`: student, begin, exercise, scene and settings, texts by word,
- `plain`: the five metrics that are read first, texts by label,
- `steps` (`what`, `state`, `seen`, `target`) and `faults` (`seconds`, `what`),
- `metrics`: all others, texts by label.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from us_sim.scoring.live import Score
from us_sim.scoring.metrics import DEFINITIONS, Metric
from us_sim.scoring.settings import STATES

MARKS = {"done": "✓", "missed": "✗", "to do": "○"}
"""Marks of steps, by their states."""
_STYLE = (
    "body {font-family: sans-serif; max-width: 70em; margin: 2em auto; padding: 0 1em} "
    "td {padding: 0.15em 1em 0.15em 0; vertical-align: top} img {width: 100%} "
    ".plain td:last-child {font-size: 1.4em} .fault {color: #a33}"
)
_ALT = "The probe's way over the skin, with the force; force and areas of vessels over time"


def select_plain_metrics(score: Score, force_limit: float) -> list[Metric]:
    """Return the five that are read first: time, force, time above its limit, way, points."""
    known = {each.name: each.value for each in score.metrics}
    over = f"Time above {force_limit:g} N"
    done = sum(step.is_done for step in score.steps)
    seconds = np.nan if score.seconds is None else score.seconds
    return [
        Metric("Time", "s", seconds),
        Metric("Highest force", "N", known.get("Peak Probe Force", np.nan)),
        Metric(over, "s", known.get(over, np.nan)),
        Metric("Way of the probe", "mm", known.get("Path Length", np.nan)),
        Metric("Points right", f"of {len(score.steps)}", done),
    ]


def classify_attempt(score: Score, void: str = "") -> str:
    """Return the state of an attempt, one of `STATES`; ``void`` says why it does not count."""
    if void:
        return "void"
    if score.seconds is None:
        return "to do" if score.was_in_air else "to lift"
    if score.has_ended:
        return "passed" if all(step.is_done for step in score.steps) else "not passed"
    return "running"


def render_page(result: Mapping[str, Any], picture: bytes = b"") -> str:
    """Return the document of a result, with a PNG of the score, as a page in one file."""
    title = escape(result["name"])
    steps = [(MARKS[s["state"]], s["what"], s["seen"]) for s in result["steps"]]
    faults = [(f"{each['seconds']} s", each["what"]) for each in result["faults"]]
    more = [(label, text, _define(label)) for label, text in result["metrics"].items()]
    shown = f'<img src="{encode_picture(picture)}" alt="{_ALT}">' if picture else ""
    return (
        f'<!DOCTYPE html><html lang="en"><meta charset="utf-8"><title>{title}</title>'
        f"<style>{_STYLE}</style><h1>{title}</h1>"
        f"<h2>{STATES[result['state']].capitalize()}</h2>"
        f"<p>{escape(result['description'])}</p>"
        f"{_table(result['plain'].items(), 'plain')}{_table(steps)}"
        f"{'<h2>Faults</h2>' if faults else ''}{_table(faults, 'fault')}{shown}"
        f"<h2>About</h2>{_table(result['about'].items())}"
        f"<details><summary>More</summary>{_table(more)}</details></html>"
    )


def encode_picture(picture: bytes) -> str:
    """Return a PNG as a data URL."""
    return f"data:image/png;base64,{base64.b64encode(picture).decode()}"


def _define(label: str) -> str:
    """Return the definition of the metric whose name a label begins with; "" if it needs none."""
    return next((text for name, text in DEFINITIONS.items() if label.startswith(name)), "")


def _table(rows: Iterable[Sequence[str]], kind: str = "") -> str:
    cells = ("".join(f"<td>{escape(str(cell))}</td>" for cell in row) for row in rows)
    return f'<table class="{kind}">{"".join(f"<tr>{row}</tr>" for row in cells)}</table>'
