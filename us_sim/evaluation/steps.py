"""Long work, step by step, with a bar that shows how far it is."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from us_sim.progress import Progress

T = TypeVar("T")


def steps(
    description: str, work: Sequence[T], unit: str, name: Callable[[T], str] = str
) -> Iterator[T]:
    """The pieces of work one after another; the bar shows the name of the one that goes on."""
    with Progress(description, len(work), unit) as progress:
        for done, piece in enumerate(work):
            progress.update(done, name(piece))
            yield piece
        progress.update(len(work))
