"""The table of a class: all results that were written to one place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd


def tabulate_results(results: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Return one row for each result: student, exercise, begin, state, and plain metrics.

    Args:
        results: documents, by the time of their begin.
    """
    rows = []
    for result in results:
        about, steps = result["about"], result["steps"]
        right = sum(step["state"] == "done" for step in steps)
        rows.append(
            {
                "student": about.get("student") or "somebody",
                "exercise": result["name"],
                "begun": about["begun"],
                "result": result["state"],
                **dict([*result["plain"].items()][:-1]),  # the last is right and of
                "right": right,
                "of": len(steps),
                "faults": len(result["faults"]),
                "volume": about.get("volume", ""),
                "changed": about.get("changed", ""),
                "checksum": about.get("checksum", ""),
            }
        )
    return pd.DataFrame(rows)
