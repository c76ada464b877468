"""Tables that can be read in Markdown and in a terminal.

>>> from us_sim.evaluation.markdown_table import markdown_table
>>> print(markdown_table(("method", "ms"), [("fem", "0.75"), ("msds", "12")]))
| method | ms   |
| ------ | ---- |
| fem    | 0.75 |
| msds   | 12   |
"""

from __future__ import annotations

from collections.abc import Sequence


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table whose columns stand below each other; every row has as many cells as the head."""
    widths = [max(len(cell) for cell in column) for column in zip(head, *rows, strict=True)]
    lines = [head, ["-" * max(width, 1) for width in widths], *rows]
    return "\n".join(
        "| " + " | ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)) + " |"
        for line in lines
    )
