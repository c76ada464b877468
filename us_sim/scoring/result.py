"""The result of an attempt: a document for programs, and a page for people.

The document has `name`, `description`, `scene`, `state` (of `STATES`), `seconds`, and

- `about`: who did what, when, with what, by words,
- `plain`: the five metrics that are read first, texts by label,
- `steps` (`what`, `state`, `seen`, `target`, `pose`) and `faults` (`seconds`, `what`),
- `metrics`: all others, texts by label.
"""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from us_sim.errors import ScoreError
from us_sim.scoring.live import Score
from us_sim.scoring.metrics import DEFINITIONS, Metric
from us_sim.scoring.settings import STATES

MARKS = {"done": "✓", "missed": "✗", "to do": "○"}
"""Of steps, by their states."""
_STYLE = (
    "body {font-family: sans-serif; max-width: 70em; margin: 2em auto; padding: 0 1em} "
    "td {padding: 0.15em 1em 0.15em 0; vertical-align: top} img {width: 100%} "
    ".plain td:last-child {font-size: 1.4em} .fault {color: #a33}"
)
_ALT = "The probe's way over the skin, with the force; force and areas of vessels over time"


def plain_metrics(score: Score, force_limit: float) -> list[Metric]:
    """Return the five that are read first: time, force, time over its limit, way, points."""
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


def state_of(score: Score, void: str = "") -> str:
    """Return what became of an attempt, one of `STATES`."""
    if void:
        return "void"
    if score.seconds is None:
        return "to do" if score.was_in_air else "to lift"
    if score.has_ended:
        return "passed" if all(step.is_done for step in score.steps) else "not passed"
    return "running"


def result_page(result: Mapping[str, Any], picture: bytes = b"") -> str:
    """Return the result as a page in one file.

    Args:
        result: the document.
        picture: PNG of the score.
    """
    title = escape(result["name"])
    steps = [(MARKS[s["state"]], s["what"], s["seen"]) for s in result["steps"]]
    faults = [(f"{each['seconds']} s", each["what"]) for each in result["faults"]]
    more = [(label, text, _definition_of(label)) for label, text in result["metrics"].items()]
    shown = f'<img src="{picture_address(picture)}" alt="{_ALT}">' if picture else ""
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


def picture_address(picture: bytes) -> str:
    """Return a PNG as an address that holds it."""
    return f"data:image/png;base64,{base64.b64encode(picture).decode()}"


def write_result(result: Mapping[str, Any], picture: bytes, address: str) -> list[str]:
    """Write the document and the page, under a name of who, what and when.

    Args:
        result: the document.
        picture: PNG of the score.
        address: a folder, or one of fsspec.

    Returns:
        The two files' addresses.

    Raises:
        ScoreError: they cannot be written.
    """
    about = result["about"]
    words = (about.get("student") or "somebody", result["name"], about["begun"])
    name = "-".join(re.sub(r"[^\w.]+", "_", each).strip("_") for each in words)
    page, document = result_page(result, picture), json.dumps(result, indent=2)
    written = []
    for suffix, text in ((".html", page), (".json", document)):
        file = f"{address.rstrip('/')}/{name}{suffix}"
        try:
            if "://" in address:
                with _fsspec().open(file, "w", encoding="utf-8") as opened:
                    opened.write(text)
            else:
                path = Path(file)
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(text, encoding="utf-8")
        except ScoreError:
            raise
        except Exception as error:  # what a file system raises is its own
            raise ScoreError(f"results: {file} cannot be written: {error}") from error
        written.append(file)
    return written


def read_results(address: str) -> list[dict[str, Any]]:
    """Return the documents of a folder, or an address of fsspec, by the time of their begin.

    Raises:
        ScoreError: it cannot be read, or holds none.
    """
    try:
        if "://" in address:
            files = _fsspec().open_files(f"{address.rstrip('/')}/*.json", "r", encoding="utf-8")
            texts = []
            for each in files:
                with each as opened:
                    texts.append((each.path, opened.read()))
        else:
            found = sorted(Path(address).glob("*.json"))
            texts = [(str(file), file.read_text(encoding="utf-8")) for file in found]
    except ScoreError:
        raise
    except Exception as error:
        raise ScoreError(f"--class {address}: cannot be read: {error}") from error
    results = [_read(name, text) for name, text in texts]
    if not results:
        raise ScoreError(f"--class {address}: holds no result of `us-sim view --results`")
    return sorted(results, key=lambda each: str(each["about"]["begun"]))


def _read(name: str, text: str) -> dict[str, Any]:
    try:
        result = json.loads(text)
        missing = {"name", "state", "about", "plain", "steps", "faults"} - set(result)
        if missing:
            raise ValueError(f"it has no {', '.join(sorted(missing))}")
        result["about"]["begun"]
    except (ValueError, TypeError, KeyError) as error:
        raise ScoreError(f"{name}: is no result of `us-sim view --results`: {error}") from error
    return dict(result)


def _fsspec() -> Any:
    try:
        import fsspec
    except ImportError as error:
        raise ScoreError("results: an address needs fsspec: pip install fsspec") from error
    return fsspec


def _definition_of(label: str) -> str:
    """Return the definition of the metric whose name a label begins with; "" where it has none."""
    return next((text for name, text in DEFINITIONS.items() if label.startswith(name)), "")


def _table(rows: Iterable[Sequence[str]], kind: str = "") -> str:
    cells = ("".join(f"<td>{escape(str(cell))}</td>" for cell in row) for row in rows)
    return f'<table class="{kind}">{"".join(f"<tr>{row}</tr>" for row in cells)}</table>'
