"""The folder that a run's rows, pictures and report are written to.

A folder that holds a report is refused before anything is measured, so that nothing that took
hours is lost; what a run that was interrupted left there is written over.
"""

from __future__ import annotations

import csv
import tempfile
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

from us_sim.errors import UsSimError
from us_sim.evaluation.machine import machine
from us_sim.evaluation.row import Row

_PRINTED = 10  # failures, at the end of a run
_LISTED = 60  # failures, in the report


class ReportFolder:
    """Where one run of ``us-sim evaluate`` writes.

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
        write_rows(self._out / f"{name}.csv", rows)

    def opening(self, *libraries: str, tables: Sequence[str] = ()) -> str:
        """The report's first words: what was run, for how long, on what, and where the rows are."""
        command = f"us-sim evaluate {self.subject}{' --quick' if self.quick else ''}"
        files = " and ".join(f"[{name}.csv]({name}.csv)" for name in tables or [self.subject])
        seconds = time.perf_counter() - self._begun
        return f"`{command}`, {seconds:.0f} s, on {machine(*libraries)}. Every row is in {files}."

    def write_report(self, parts: Iterable[str], failures: Sequence[str]) -> None:
        """Write the report: its paragraphs but for empty ones, and what failed."""
        lines = [f"- {failure}" for failure in failures[:_LISTED]]
        if len(failures) > _LISTED:
            lines.append(f"- and {len(failures) - _LISTED} more")
        failed = ["## Failed", "\n".join(lines)] if failures else []
        text = "\n\n".join(part for part in (*parts, *failed) if part) + "\n"
        self.report.write_text(text, encoding="utf-8")

    def finish(self, table: str, failures: Sequence[str]) -> int:
        """Print a table, where everything is, and what failed; 1 if anything did, else 0."""
        print(table)
        print(f"Report: {self.report}; pictures: {', '.join(map(str, self._pictures))}")
        for failure in failures[:_PRINTED]:
            print(f"failed: {failure}")
        if len(failures) > _PRINTED:
            print(f"and {len(failures) - _PRINTED} more, see {self.report}")
        return 1 if failures else 0


def write_rows(file: Path, rows: Sequence[Row]) -> None:
    """Write a CSV file whose first line names its columns."""
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(rows[0].values)
        writer.writerows(row.cells for row in rows)
