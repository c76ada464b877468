"""The one way in which every evaluation writes rows (CSV), tables (Markdown), pictures and text.

The prose of a report stands in templates beside its subject's code, ``report.md`` and others, with
places such as ``$opening`` for what was measured.

>>> from us_sim.evaluation.report import Row, markdown_table
>>> @dataclass(frozen=True)
... class Point(Row):
...     method: str
...     ms: float = float("nan")
...     setup: float = not_a_column(0.5)
>>> row = Point("fem", 0.123456)
>>> list(row.values), row.cells
(['method', 'ms'], ['fem', '0.1235'])
>>> print(markdown_table(("method", "ms"), [row.cells, ("msds", "12")]))
| method | ms     |
| ------ | ------ |
| fem    | 0.1235 |
| msds   | 12     |
>>> Target.at_most("an image", 2.0, 1.5, "ms").cells
('an image', 'at most 2 ms', '1.5 ms', 'yes')
>>> round(exponent({10: 2.0, 20: 8.0, 40: 32.0}), 3)
2.0
"""

from __future__ import annotations

import csv
import platform
import re
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from importlib.metadata import PackageNotFoundError, version
from os import cpu_count
from pathlib import Path
from string import Template
from typing import Any, ClassVar

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter

from us_sim.errors import UsSimError


@dataclass(frozen=True)
class Row:
    """Base of the dataclasses of which each instance is a row of a CSV file."""

    digits: ClassVar[int] = 4  # significant digits of the numbers in the file
    decimals: ClassVar[int | None] = None  # or the digits after their points

    @property
    def values(self) -> dict[str, object]:
        """By column, in order."""
        columns = (entry for entry in fields(self) if entry.metadata.get("column", True))
        return {entry.name: getattr(self, entry.name) for entry in columns}

    @property
    def cells(self) -> list[str]:
        """The values as in the file; a number that is not known is empty."""
        return [self._cell(value) for value in self.values.values()]

    @property
    def title(self) -> str:
        """The measured case, in a sentence about a failure."""
        return ", ".join(self.cells[:2])

    def _cell(self, value: object) -> str:
        if value is None or (isinstance(value, float) and np.isnan(value)):
            return ""
        if isinstance(value, bool):
            return str(value).lower()
        if not isinstance(value, float):
            return str(value)
        if self.decimals is not None:
            return str(round(value, self.decimals))
        return f"{value:.{self.digits}g}"


def not_a_column(default: Any) -> Any:
    """A field that the report knows and the file does not have."""
    return field(default=default, metadata={"column": False})


def failures(rows: Iterable[Row]) -> list[str]:
    """Title and error of the rows whose ``failure`` is not empty."""
    failed = ((row.title, getattr(row, "failure", "")) for row in rows)
    return [f"{title}: {failure}" for title, failure in failed if failure]


def words_of(error: Exception) -> str:
    """An error in one line."""
    return f"{type(error).__name__}: {error}".replace("\n", " ")


def write_rows(file: Path, rows: Sequence[Row]) -> None:
    """Write a CSV file whose first line names the columns of all rows."""
    with file.open("w", newline="", encoding="utf-8") as stream:
        columns = list(dict.fromkeys(name for row in rows for name in row.values))
        writer = csv.DictWriter(stream, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(dict(zip(row.values, row.cells, strict=True)) for row in rows)


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table whose columns stand below each other; every row has as many cells as the head."""
    widths = [max(len(cell) for cell in column) for column in zip(head, *rows, strict=True)]
    lines = [head, ["-" * max(width, 1) for width in widths], *rows]
    return "\n".join(
        "| " + " | ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)) + " |"
        for line in lines
    )


def number(value: Any, form: str = ".3g", unknown: str = "") -> str:
    """A number in a table; ``unknown`` where it is not finite."""
    return f"{value:{form}}" if np.isfinite(value) else unknown


def percentile(values: Sequence[float] | np.ndarray, percent: float) -> float:
    """A percentile; NaN of no values."""
    return float(np.percentile(values, percent)) if len(values) else float("nan")


def exponent(cost_of_size: Mapping[float, float]) -> float:
    """k in cost ~ size^k, by least squares of the logarithms; NaN with fewer than two sizes.

    Costs that are not positive and finite are left out.
    """
    known = {n: cost for n, cost in cost_of_size.items() if np.isfinite(cost) and cost > 0}
    if len(known) < 2:
        return float("nan")
    return float(np.polyfit(np.log(list(known)), np.log(list(known.values())), 1)[0])


@dataclass(frozen=True)
class Target:
    """One line of a report's table of targets."""

    what: str
    asked: str
    seen: str = "not measured"
    met: bool | None = None  # None where it was not measured

    @classmethod
    def at_most(
        cls, what: str, limit: float, seen: float, unit: str = "", *, form: str = ".3g"
    ) -> Target:
        """A limit from above; ``seen`` is NaN where it was not measured."""
        return cls._limit(what, f"at most {limit:g}", seen, seen <= limit, unit, form)

    @classmethod
    def under(cls, what: str, limit: float, seen: float, unit: str = "") -> Target:
        """A limit from above that is itself too much."""
        return cls._limit(what, f"under {limit:g}", seen, seen < limit, unit, ".3g")

    @classmethod
    def at_least(cls, what: str, limit: float, seen: float, *, form: str = ".3g") -> Target:
        """A limit from below."""
        return cls._limit(what, f"at least {limit:g}", seen, seen >= limit, "", form)

    @classmethod
    def _limit(cls, what: str, asked: str, seen: float, met: bool, unit: str, form: str) -> Target:
        unit = unit and f" {unit}"
        if not np.isfinite(seen):
            return cls(what, asked + unit)
        return cls(what, asked + unit, f"{seen:{form}}{unit}", bool(met))

    @property
    def cells(self) -> tuple[str, str, str, str]:
        """Cells in the table."""
        return self.what, self.asked, self.seen, {True: "yes", False: "no", None: ""}[self.met]


def target_table(targets: Sequence[Target]) -> str:
    """All targets in Markdown."""
    return markdown_table(("", "asked", "seen", "met"), [target.cells for target in targets])


@contextmanager
def picture(file: Path, width: float, height: float, title: str) -> Iterator[Figure]:
    """An empty figure (inches) with its title at the left, written as PNG when it is drawn."""
    figure = Figure(figsize=(width, height), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=12, x=0.01, ha="left")
    yield figure
    figure.savefig(file, dpi=figure.dpi)


def panel_grid(figure: Figure, titles: Iterable[str], x: str, y: str) -> list[Axes]:
    """A panel for each title, three in a row, with common axes that have these labels."""
    names = list(titles)
    columns = min(3, len(names))
    rows = -(-len(names) // columns)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for at, panel in enumerate(axes.flat):
        if at >= len(names):
            panel.set_visible(False)
            continue
        panel.set_title(names[at], fontsize=11, loc="left")
        if at + columns >= len(names):
            panel.set_xlabel(x)
            panel.tick_params(labelbottom=True)
    for panel in axes[:, 0]:
        panel.set_ylabel(y)
    return list(axes.flat[: len(names)])


def plain(panel: Axes) -> None:
    """Numbers without powers of ten, a faint grid, and no frame at the top and the right."""
    for axis in (panel.xaxis, panel.yaxis):
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    panel.grid(True, which="major", color="0.93")
    panel.set_axisbelow(True)
    panel.spines[["top", "right"]].set_visible(False)
    panel.tick_params(labelsize=8.5)


def plain_bars(panel: Axes) -> None:
    """As `plain`, of horizontal bars with names."""
    panel.grid(True, axis="x", color="0.93")
    panel.set_axisbelow(True)
    panel.spines[["top", "right"]].set_visible(False)
    panel.tick_params(labelsize=8.5)


def method_keys(methods: Mapping[str, Any], **look: Any) -> list[Line2D]:
    """Entries of a key: the methods, by name, with their colours and marks."""
    return [
        Line2D([], [], color=method.colour, marker=method.mark, label=name, **look)
        for name, method in methods.items()
    ]


def key_beside(panel: Axes, handles: list | None = None) -> None:  # type: ignore[type-arg]
    """Key of colours and marks to the right of a panel; none where it has nothing with a label."""
    if handles is not None or panel.get_legend_handles_labels()[0]:
        beside: Any = {"loc": "center left", "bbox_to_anchor": (1.01, 0.5)}
        panel.legend(handles=handles, fontsize=8, frameon=False, **beside)


def machine(*libraries: str) -> str:
    """Name processor, cores, system, and the versions of Python and of the libraries it has."""
    processor = platform.processor() or platform.machine()
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                processor = line.partition(":")[2].strip()
                break
    except OSError:
        pass
    parts = [processor, f"{cpu_count()} cores", platform.system()]
    parts.append(f"Python {platform.python_version()}")
    for name in dict.fromkeys(["numpy", "scipy", "numba", *libraries]):
        try:
            parts.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    return ", ".join(parts)


def filled(subject: str, name: str, **values: str) -> str:
    """The template ``subject/name.md`` with its places filled; empty paragraphs are left out.

    Raises:
        ValueError: the template's places are not those of ``values``.
    """
    file = Path(__file__).with_name(subject) / f"{name}.md"
    template = Template(file.read_text(encoding="utf-8"))
    if wrong := set(template.get_identifiers()) ^ set(values):
        raise ValueError(f"{file}: {', '.join(sorted(wrong))} stand in the template or are given")
    return re.sub(r"\n{3,}", "\n\n", template.substitute(values)).strip()


class ReportFolder:
    """Folder that one run of ``us-sim evaluate`` writes to.

    One that holds a report is refused before anything is measured, so that nothing that took hours
    is lost; files of a run that was interrupted are written over.

    Args:
        subject: that is evaluated.
        out: the folder, made if it is not there.
        quick: whether it is the short run.

    Raises:
        UsSimError: the folder cannot be written, or holds a report.
    """

    def __init__(self, subject: str, out: Path, quick: bool) -> None:
        self.subject, self.quick = subject, quick
        self._out, self._begun = out, time.perf_counter()
        self._pictures: list[Path] = []
        self._tables: list[str] = []
        try:
            out.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=out):
                pass
        except OSError as error:
            raise UsSimError(
                f"--out {out}: cannot be written ({error.strerror or error}); name another folder"
            ) from error
        if self.report.exists():
            raise UsSimError(f"{self.report} exists already; choose another folder with --out")

    @property
    def report(self) -> Path:
        """The file that is written last."""
        return self._out / f"{self.subject}.md"

    def picture(self, name: str) -> Path:
        """The file of a picture that is about to be drawn, named after the subject."""
        self._pictures.append(self._out / f"{self.subject}_{name}.png")
        return self._pictures[-1]

    def write_rows(self, name: str, rows: Sequence[Row]) -> None:
        """Write ``name``.csv."""
        self._tables.append(f"[{name}.csv]({name}.csv)")
        write_rows(self._out / f"{name}.csv", rows)

    def finish(
        self, table: str, failures: Sequence[str], libraries: Sequence[str], /, **values: str
    ) -> int:
        """Write the report; print a table, the files, and the failures.

        The subject's template ``report`` is filled, with the first sixty failures below. Its place
        ``$opening`` says how long the run took, on which machine with which versions of
        ``libraries``, and where its rows are.

        Returns:
            1 if there are failures, else 0.
        """
        command = f"us-sim evaluate {self.subject}{' --quick' if self.quick else ''}"
        seconds = time.perf_counter() - self._begun
        opening = (
            f"`{command}`, {seconds:.0f} s, on {machine(*libraries)}. "
            f"Every row is in {' and '.join(self._tables)}."
        )
        text = filled(self.subject, "report", opening=opening, **values)
        if failures:
            more = [f"and {len(failures) - 60} more"] if len(failures) > 60 else []
            text += "\n\n## Failed\n\n"
            text += "\n".join(f"- {failure}" for failure in [*failures[:60], *more])
        self.report.write_text(text + "\n", encoding="utf-8")
        print(table)
        print(f"Report: {self.report}; pictures: {', '.join(map(str, self._pictures))}")
        for failure in failures[:10]:
            print(f"failed: {failure}")
        if len(failures) > 10:
            print(f"and {len(failures) - 10} more, see {self.report}")
        return 1 if failures else 0
