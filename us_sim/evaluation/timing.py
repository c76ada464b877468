"""How long each run of a method took.

>>> import numpy as np
>>> from us_sim.evaluation.timing import RunTimes
>>> times = RunTimes(np.arange(1.0, 102.0))
>>> times.median, times.p99
(51.0, 100.0)

When a tissue under a probe at rest has come to rest itself.

>>> from us_sim.evaluation.timing import frames_until
>>> frames_until([1.0, 1e-4, 0.5, 9e-4, 1e-6], 1e-3), frames_until([1.0], 1e-3)
(3, None)

Long work, step by step, with a bar that shows how far it is.

Cases that take their time, run one after another with a bar; what breaks in one leaves the rest.

>>> from us_sim.evaluation.timing import timed_cases
>>> timed_cases("halves", {1: 0.01, 0: 0.01}, lambda case, _: 1 / case, lambda _, words: words)
[1.0, 'ZeroDivisionError: division by zero']
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from us_sim.evaluation.report import words_of
from us_sim.progress import Progress


@dataclass(frozen=True, eq=False)
class RunTimes:
    """The wall clock of runs, one after another."""

    milliseconds: NDArray[np.float64]  # (R,) of each

    @property
    def median(self) -> float:
        """ms, of a run."""
        return float(np.median(self.milliseconds))

    @property
    def p99(self) -> float:
        """ms, which one run in a hundred exceeds."""
        return float(np.percentile(self.milliseconds, 99))


def frames_until(residual: Sequence[float] | NDArray[np.float64], small: float) -> int | None:
    """After how many frames a residual is as small as asked and stays so; None where it is not.

    The first residual is that of the frame before, so that none is needed where it is small.
    """
    large = np.flatnonzero(~(np.asarray(residual) <= small))
    after = int(large[-1]) + 1 if len(large) else 0
    return after if after < len(residual) else None


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


C = TypeVar("C")
P = TypeVar("P")

Tell = Callable[[float, str], None]
"""Takes how many s of a case are over, and what is done now."""


def timed_cases(
    subject: str,
    seconds: Mapping[C, float],
    run: Callable[[C, Tell], P],
    failed: Callable[[C, str], P],
) -> list[P]:
    """What each case shows.

    Args:
        subject: that is evaluated.
        seconds: how long each case takes, s.
        run: runs one.
        failed: what stands for one that broke, from the words of its error.
    """
    points: list[P] = []
    done = 0.0
    with Progress(subject, sum(seconds.values()), "s") as progress:
        for case, most in seconds.items():

            def tell(passed: float, words: str, case: C = case, before: float = done) -> None:
                progress.update(before + min(passed, seconds[case]), f"{case}: {words}")

            try:
                points.append(run(case, tell))
            # Whatever breaks in one case must not take the others' results along.
            except Exception as error:
                points.append(failed(case, words_of(error)))
            done += most
            progress.update(done)
    return points
