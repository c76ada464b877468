"""A line that shows how far a long run is."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable

from tqdm import tqdm

from us_sim.errors import printable

_LONGEST = 200  # characters of what is being done
_PATIENCE = 1.0  # s, for which work goes on without a bar
_UNMEASURED = "{desc}{postfix}, {elapsed}"


class Progress:
    """A bar on stderr from 0 to ``total``; without a total, only the text.

    Where stderr is no terminal it writes a line every few seconds instead.

    Args:
        description: of the work.
        total: amount of work.
        unit: of the amount.
        delay: s, before which nothing is drawn.
    """

    def __init__(
        self, description: str, total: float | None = None, unit: str = "", *, delay: float = 0.0
    ) -> None:
        self._measured = (
            "{desc}{postfix}"
            if total is None
            else "{desc}: {percentage:3.0f} %|{bar}| {n:.0f}/{total:.0f} "
            + f"{unit}, "
            + "{elapsed}{postfix}"
        )
        self._bar = tqdm(
            desc=description,
            total=total,
            bar_format=self._measured,
            mininterval=0.1 if sys.stderr.isatty() else 3.0,
            ascii=not sys.stderr.isatty(),
            miniters=0,
            ncols=shutil.get_terminal_size((100, 24)).columns,
            leave=True,
            delay=delay,
        )

    def update(self, done: float, text: str = "") -> None:
        """Show that ``done`` of the total is done."""
        if self._bar.total is not None:
            done = min(done, self._bar.total)
        self._show(self._measured, text, done - self._bar.n)

    def tell(self, text: str) -> None:
        """Show the step of work whose amount is unknown."""
        self._show(_UNMEASURED, text, 0)

    def _show(self, layout: str, text: str, more: float) -> None:
        self._bar.bar_format = layout
        self._bar.set_postfix_str(printable(text, _LONGEST), refresh=False)
        self._bar.update(more)

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()


def late_progress(description: str) -> Callable[[float, str], None]:
    """Return a callback for work that is mostly short: it draws a bar once a second has passed.

    It takes the fraction done and what is being done; 0 shows no percentage, since of what has
    just begun, or is compiled, nobody knows it. At 1 the bar is finished, and the next call begins
    another.
    """
    bar: Progress | None = None

    def show(fraction: float, text: str) -> None:
        nonlocal bar
        bar = bar or Progress(description, 100, "%", delay=_PATIENCE)
        if fraction > 0.0:
            bar.update(100 * fraction, text)
        else:
            bar.tell(text)
        if fraction >= 1.0:
            bar.__exit__()
            bar = None

    return show


def end_late_bars() -> None:
    """End the lines of bars whose work was broken off, so that a sentence begins on its own."""
    for bar in [*tqdm._instances]:  # type: ignore[attr-defined]
        bar.close()
