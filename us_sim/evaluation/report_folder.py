"""The folder that a report and its rows are written to."""

from __future__ import annotations

import csv
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path

from us_sim.errors import UsSimError

__all__ = ["prepare_folder", "write_rows"]


def prepare_folder(out: Path, report: str) -> None:
    """Make sure of the folder before a long run, and that it holds no such report.

    Args:
        out: made if it is not there.
        report: the file that the run writes last.

    Raises:
        UsSimError: it cannot be written, or holds a report.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as error:
        raise UsSimError(
            f"--out {out}: cannot be written ({error.strerror or error}); name another folder"
        ) from error
    if (out / report).exists():
        raise UsSimError(f"{out / report} exists already; choose another folder with --out")


def write_rows(file: Path, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a CSV file with a line that names its columns."""
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(columns)
        writer.writerows(rows)
