"""Cases that take their time, run one after another with a bar; what breaks in one leaves the rest.

>>> from us_sim.evaluation.timed_cases import timed_cases
>>> timed_cases("halves", {1: 0.01, 0: 0.01}, lambda case, _: 1 / case, lambda _, words: words)
[1.0, 'ZeroDivisionError: division by zero']
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeVar

from us_sim.evaluation.row import words_of
from us_sim.progress import Progress

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
