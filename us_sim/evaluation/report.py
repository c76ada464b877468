"""Parts of all subjects' reports: tables, percentiles, power laws, the machine.

>>> from us_sim.evaluation.report import fit_exponent, format_markdown_table
>>> print(format_markdown_table(("method", "ms"), [("fem", "0.1235"), ("msds", "12")]))
| method | ms     |
| ------ | ------ |
| fem    | 0.1235 |
| msds   | 12     |
>>> round(fit_exponent({10: 2.0, 20: 8.0, 40: 32.0}), 3)
2.0
"""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from os import cpu_count
from pathlib import Path

import numpy as np
import pandas as pd


def format_markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a table in Markdown, with aligned columns; rows have as many cells as the head."""
    widths = [max(len(cell) for cell in column) for column in zip(head, *rows, strict=True)]
    lines = [head, ["-" * max(width, 1) for width in widths], *rows]
    return "\n".join(
        "| " + " | ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)) + " |"
        for line in lines
    )


def read_case(table: pd.DataFrame, case: object, column: str) -> float:
    """Return a column's value of a case; NaN if it failed."""
    rows = table[table["case"] == str(case)]
    return float(rows[column].iloc[0]) if len(rows) else np.nan


def compute_percentile(values: Sequence[float] | np.ndarray, percent: float) -> float:
    """Compute a percentile; NaN of no values."""
    return float(np.percentile(values, percent)) if len(values) else float("nan")


def fit_exponent(cost_of_size: Mapping[float, float]) -> float:
    """Fit k in cost ~ size^k, by least squares of the logarithms; NaN of fewer than two sizes.

    Costs that are not positive and finite are left out.
    """
    known = {n: cost for n, cost in cost_of_size.items() if np.isfinite(cost) and cost > 0}
    if len(known) < 2:
        return float("nan")
    return float(np.polyfit(np.log(list(known)), np.log(list(known.values())), 1)[0])


def describe_machine(*libraries: str) -> str:
    """Name processor, cores, system, and versions of Python and of installed libraries."""
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
