"""The rows of a report's CSV file: each a dataclass whose fields are the columns.

>>> from dataclasses import dataclass
>>> from us_sim.evaluation.row import Row, not_a_column
>>> @dataclass(frozen=True)
... class Point(Row):
...     method: str
...     ms: float = float("nan")
...     setup: float = not_a_column(0.5)
>>> row = Point("fem", 0.123456)
>>> list(row.values), row.cells
(['method', 'ms'], ['fem', '0.1235'])
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar

import numpy as np


@dataclass(frozen=True)
class Row:
    """Base of the dataclasses of which each instance is a row."""

    digits: ClassVar[int] = 4
    """Significant digits of the numbers in the file."""
    decimals: ClassVar[int | None] = None
    """Or the digits after their points."""

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
        """What the row is about, in a sentence about a failure."""
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
    """What went wrong in which rows: those whose ``failure`` is not empty."""
    failed = ((row.title, getattr(row, "failure", "")) for row in rows)
    return [f"{title}: {failure}" for title, failure in failed if failure]


def words_of(error: Exception) -> str:
    """An error in one line."""
    return f"{type(error).__name__}: {error}".replace("\n", " ")
