"""A subject of `us-sim evaluate`: pieces of work that yield rows, and a report of the table.

A subject is a folder with a module that makes one `Subject`, and a page ``report.md``. Its
``pieces`` are the work, by the name of the CSV file of their rows; each `Piece` names the case that
it measures, and has a function that returns rows (dicts). The engine shows the progress, calls one
piece after another, adds the case to each row, records the error of a piece that fails (a row may
also have a ``failure``), and writes the CSV: columns stand in the order of their first row, and
keys that the subject names as ``hidden``, such as an image, are for the report alone.

The subject's ``report`` gets a pandas DataFrame for each CSV file, in order, without failed pieces,
and returns the `Report`: at most five lines to take home, `Target`s if there are any, and the
contents of the places ``$name`` of the page. A place holds text, a list of lines (a bulleted list),
a DataFrame (a table), or a figure of `us_sim.evaluation.figures` (written as
``SUBJECT_name.png``). A section of the page (from ``##`` to the next) whose places are all empty is
left out.

The page has: title, lines to take home, command and machine, targets, ``report.md``, failures. The
command is ``us-sim evaluate SUBJECT [--quick]``; it calls the `Subject` with the folder, ``quick``,
and the subject's settings if it has some, which go to ``pieces``, too. It prints the lines to take
home, and returns 1 if a piece failed.

>>> from us_sim.evaluation.subject import Target, format_data_frame
>>> Target.at_most("an image", 2.0, 1.5, "ms").cells
('an image', 'at most 2 ms', '1.5 ms', 'yes')
>>> print(format_data_frame(pd.DataFrame([{"method": "fem", "ms": 0.123456}, {"method": "msds"}])))
| method | ms    |
| ------ | ----- |
| fem    | 0.123 |
| msds   |       |
"""

from __future__ import annotations

import re
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from string import Template
from typing import Any, TypeAlias

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from PIL import Image

from us_sim.errors import UsSimError
from us_sim.evaluation.report import describe_machine, format_markdown_table
from us_sim.progress import ProgressBar

Place: TypeAlias = "str | Sequence[str] | pd.DataFrame | Figure"


@dataclass(frozen=True)
class Piece:
    """One piece of a subject's work."""

    case: Mapping[str, Any]  # the columns that name what is measured, in each of its rows
    measure: Callable[[], Iterable[Mapping[str, Any]]]

    def __str__(self) -> str:
        if "case" in self.case:
            return str(self.case["case"])
        return ", ".join(_format_cell(value, ".4g") for value in list(self.case.values())[:4])


@dataclass(frozen=True)
class Target:
    """One line of a report's table of targets."""

    quantity: str
    asked: str
    measured: str = "not measured"
    met: bool | None = None  # None if it was not measured

    @classmethod
    def at_most(cls, quantity: str, limit: float, value: float, unit: str = "") -> Target:
        """Set a limit from above; ``value`` is NaN if it was not measured."""
        return cls._set_limit(quantity, f"at most {limit:g}", value, value <= limit, unit)

    @classmethod
    def at_least(cls, quantity: str, limit: float, value: float, unit: str = "") -> Target:
        """Set a limit from below; ``value`` is NaN if it was not measured."""
        return cls._set_limit(quantity, f"at least {limit:g}", value, value >= limit, unit)

    @classmethod
    def _set_limit(cls, quantity: str, asked: str, value: float, met: bool, unit: str) -> Target:
        unit = unit and f" {unit}"
        if not np.isfinite(value):
            return cls(quantity, asked + unit)
        return cls(quantity, asked + unit, f"{value:.3g}{unit}", bool(met))

    @property
    def cells(self) -> tuple[str, str, str, str]:
        """Cells of the target in the table."""
        met = {True: "yes", False: "no", None: ""}[self.met]
        return self.quantity, self.asked, self.measured, met


@dataclass(frozen=True)
class Report:
    """A subject's findings: lines to take home, contents of the page, targets."""

    take_home: Sequence[str]  # at most five lines
    places: Mapping[str, Place]
    targets: Sequence[Target] = ()


@dataclass(frozen=True)
class Subject:
    """One subject, called to measure it and write its report."""

    name: str
    title: str
    pieces: Callable[..., Mapping[str, Sequence[Piece]]]  # of quick, and the settings if any
    report: Callable[..., Report]  # of a DataFrame a CSV file
    hidden: Sequence[str] = ()  # keys of rows that are no columns of the CSV
    libraries: Sequence[str] = ()  # whose versions matter, besides those of every subject
    digits: int = 4  # significant, of numbers in the CSV

    def __call__(self, out: Path, quick: bool, *settings: Any) -> int:
        """Measure everything and write CSV files, pictures and the page into a folder.

        Args:
            out: the folder, made if it is not there.
            quick: run the short version.
            settings: of the subject, if it has some.

        Returns:
            1 if a piece failed, else 0.

        Raises:
            UsSimError: the folder cannot be written, or holds a report; nothing is measured then.
        """
        page = out / f"{self.name}.md"
        _check_folder(out, page)
        begun = time.perf_counter()
        tables: dict[str, pd.DataFrame] = {}
        failures: list[str] = []
        for name, pieces in self.pieces(quick, *settings).items():
            rows, broken, failed = _measure(name, pieces)
            tables[name] = pd.DataFrame(rows)
            failures += failed
            self._write_csv(out / f"{name}.csv", pd.DataFrame([*rows, *broken]))
        if any(table.empty for table in tables.values()):
            report = Report(["Nothing was measured."], {})
        else:
            report = self.report(*tables.values())
        seconds = time.perf_counter() - begun
        command = f"us-sim evaluate {self.name}{' --quick' if quick else ''}"
        files = " and ".join(f"[{name}.csv]({name}.csv)" for name in tables)
        targets = pd.DataFrame(
            [target.cells for target in report.targets], columns=["", "asked", "seen", "met"]
        )
        parts = (
            f"# {self.title}",
            _format_place(report.take_home),
            f"`{command}`, {seconds:.0f} s, on {describe_machine(*self.libraries)}. "
            f"Every row is in {files}.",
            _format_place(targets),
            self._fill_page(out, report.places),
            "## Failed" if failures else "",
            _format_place(failures),
        )
        page.write_text("\n\n".join(part for part in parts if part) + "\n", encoding="utf-8")
        print("\n".join([*report.take_home, f"Report: {page}"]))
        for failure in failures[:10]:
            print(f"failed: {failure}")
        return 1 if failures else 0

    def _write_csv(self, file: Path, table: pd.DataFrame) -> None:
        shown = table.drop(columns=[name for name in self.hidden if name in table])
        # Counts that some rows lack are counts all the same.
        cells = shown.convert_dtypes().map(lambda value: _format_cell(value, f".{self.digits}g"))
        cells.to_csv(file, index=False, lineterminator="\n")

    def _fill_page(self, out: Path, places: Mapping[str, Place]) -> str:
        """Write the figures, and return the text of ``report.md`` with its places filled."""
        filled = {}
        for name, place in places.items():
            if isinstance(place, Figure):
                picture, drawn = out / f"{self.name}_{name}.png", BytesIO()
                place.savefig(drawn, dpi=110)
                # With a palette of 256 colours it looks the same, at a third of the size.
                Image.open(drawn).convert("RGB").quantize().save(picture, optimize=True)
                filled[name] = f"![{place.get_label()}]({picture.name})"
            else:
                filled[name] = _format_place(place)
        text = Path(__file__).with_name(self.name).joinpath("report.md").read_text(encoding="utf-8")
        sections = []
        for section in re.split(r"\n(?=## )", text):
            asked = Template(section).get_identifiers()
            if not asked or any(filled.get(name) for name in asked):
                sections.append(Template(section).safe_substitute(filled).strip())
        return re.sub(r"\n{3,}", "\n\n", "\n\n".join(sections))


def format_data_frame(table: pd.DataFrame) -> str:
    """Format a table in Markdown, its floats with three digits; missing values are empty."""
    rows = [[_format_cell(cell, ".3g") for cell in row] for row in table.astype(object).to_numpy()]
    return format_markdown_table([str(name) for name in table.columns], rows) if rows else ""


def _format_cell(value: Any, form: str) -> str:
    if isinstance(value, bool | np.bool_):
        return str(value).lower()
    if value is None or value is pd.NA or value != value:  # NaN is no number that equals itself
        return ""
    return f"{value:{form}}" if isinstance(value, float | np.floating) else str(value)


def _format_place(place: str | Sequence[str] | pd.DataFrame) -> str:
    if isinstance(place, pd.DataFrame):
        return format_data_frame(place)
    if isinstance(place, str):
        return place
    return "\n".join(f"- {line}" for line in place)


def _check_folder(out: Path, page: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as error:
        raise UsSimError(
            f"--out {out}: cannot be written ({error.strerror or error}); name another folder"
        ) from error
    if page.exists():
        raise UsSimError(f"{page} exists already; choose another folder with --out")


def _measure(
    name: str, pieces: Sequence[Piece]
) -> tuple[list[dict[str, Any]], list[dict[str, Any]], list[str]]:
    """Return the rows of all pieces, a row for each that broke off, and all failures in words."""
    rows, broken, failures = [], [], []
    with ProgressBar(name, len(pieces), "pieces") as progress:
        for done, piece in enumerate(pieces):
            progress.update(done, str(piece))
            try:
                for row in piece.measure():
                    rows.append({**piece.case, **row})
                    if row.get("failure"):
                        failures.append(f"{piece}: {row['failure']}")
            # Whatever breaks in one piece must not take the others' results along.
            except Exception as error:
                words = f"{type(error).__name__}: {error}".replace("\n", " ")
                broken.append({**piece.case, "failure": words})
                failures.append(f"{piece}: {words}")
        progress.update(len(pieces))
    return rows, broken, failures
