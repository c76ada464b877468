"""A line that shows how far a long run is."""

from __future__ import annotations

import shutil
import sys
from types import TracebackType

from tqdm import tqdm

__all__ = ["Progress"]


class Progress:
    """A bar on stderr from 0 to ``total``; without a total, only the text.

    Where stderr is no terminal it writes a line every few seconds instead.
    """

    def __init__(self, description: str, total: float | None = None, unit: str = "") -> None:
        layout = (
            "{desc}: {postfix}"
            if total is None
            else (
                "{desc}: {percentage:3.0f} %|{bar}| {n:.0f}/{total:.0f}"
                + f" {unit}, "
                + "{elapsed}{postfix}"
            )
        )
        self._bar = tqdm(
            desc=description,
            total=total,
            bar_format=layout,
            mininterval=0.1 if sys.stderr.isatty() else 3.0,
            ascii=not sys.stderr.isatty(),
            miniters=0,
            ncols=shutil.get_terminal_size((100, 24)).columns,
            leave=True,
        )

    def update(self, done: float, text: str = "") -> None:
        """Show that ``done`` of the total is done."""
        if self._bar.total is not None:
            done = min(done, self._bar.total)
        self._bar.set_postfix_str(text, refresh=False)
        self._bar.update(done - self._bar.n)

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._bar.close()
