"""The rows of an image divided into bands, one a thread.

>>> from us_sim.slicing.cutting.row_bands import parallel_rows
>>> done = []
>>> parallel_rows(3, 10, lambda first, end: done.append((first, end)), band=2)
>>> sorted(done)
[(0, 4), (4, 8), (8, 10)]
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable


def parallel_rows(
    threads: int, rows: int, work: Callable[[int, int], object], *, band: int = 1
) -> None:
    """Do ``work(first_row, end_row)`` for all rows in parallel, one run of them a thread.

    Args:
        work: a kernel that does not hold the interpreter's lock.
        band: rows that stay together: every run starts at a multiple of it.

    Raises:
        ValueError: fewer than one thread.
    """
    if threads < 1:
        raise ValueError(f"give at least one thread, not {threads}")
    rows_each = band * -(-rows // (band * threads))
    others = [
        _pool(threads - 1).submit(work, first, min(first + rows_each, rows))
        for first in range(rows_each, rows, rows_each)
    ]
    # The caller is a thread too: waking one fewer saves some 50 µs.
    work(0, min(rows_each, rows))
    for other in others:
        other.result()


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """The threads for all images, which are only started when they are used."""
    return ThreadPoolExecutor(threads, thread_name_prefix="rows")
