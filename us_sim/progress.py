"""A line that shows how far a long run is."""

import shutil
import sys

from tqdm.std import TRLock, tqdm  # type: ignore[attr-defined]

from us_sim import Progress
from us_sim.errors import printable_line

tqdm.set_lock(TRLock())  # its own is a semaphore, which a process that is killed would leave behind


class ProgressBar(tqdm):
    """A bar on stderr from 0 to ``total``, drawn once ``delay`` s have passed.

    Without a total it is only the text; where stderr is no terminal, a line every few seconds.
    """

    def __init__(
        self, description: str, total: float | None, unit: str = "", *, delay: float = 0.0
    ) -> None:
        amount = ": {percentage:3.0f} %|{bar}| {n:.0f}/{total:.0f} " + f"{unit}, {{elapsed}}"
        super().__init__(
            desc=description,
            total=total,
            bar_format=f"{{desc}}{'' if total is None else amount}{{postfix}}",
            mininterval=0.1 if sys.stderr.isatty() else 3.0,
            ascii=not sys.stderr.isatty(),
            miniters=0,
            ncols=shutil.get_terminal_size((100, 24)).columns,
            delay=delay,
        )

    def update(self, done: float, text: str = "") -> None:  # type: ignore[override]
        """Show that ``done`` of the total is done, and what is being done."""
        self.set_postfix_str(printable_line(text, 200), refresh=False)
        super().update((done if self.total is None else min(done, self.total)) - self.n)


def late_progress(description: str) -> Progress:
    """Return a function of the fraction done, which ends a bar at 1, and of what is being done."""
    bar: ProgressBar | None = None

    def show(fraction: float, text: str) -> None:
        nonlocal bar
        bar = bar or ProgressBar(description, 100, "%", delay=1.0)
        bar.update(100 * fraction, text)
        if fraction >= 1.0:
            bar.close()
            bar = None

    return show
