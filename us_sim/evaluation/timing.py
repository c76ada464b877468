"""Times of functions in turn, and frames until a tissue settles.

>>> from us_sim.evaluation.timing import frames_until
>>> frames_until([1.0, 1e-4, 0.5, 9e-4, 1e-6], 1e-3), frames_until([1.0], 1e-3)
(3, None)
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

C = TypeVar("C")


def medians_in_turn(
    work: Mapping[str, Callable[[Any], object]],
    count: int,
    uncounted: int,
    *,
    prepare: Callable[[int], Any] = int,
    all_threads: bool = False,
) -> dict[str, float]:
    """ms of processor time that each function takes, median, all in turn on a noisy machine.

    Args:
        work: by name; called ``count`` times with the result of ``prepare``.
        uncounted: first calls, which may compile.
        prepare: makes the argument from the call's number; its time does not count.
        all_threads: count every thread of the process.
    """
    found: dict[str, list[float]] = {name: [] for name in work}
    for k in range(count):
        for name, function in work.items():
            argument = prepare(k)
            began = time.process_time() if all_threads else time.thread_time()
            function(argument)
            ended = time.process_time() if all_threads else time.thread_time()
            found[name].append(1e3 * (ended - began))
    return {name: float(np.median(ms[uncounted:])) for name, ms in found.items()}


def frames_until(residual: Sequence[float] | NDArray[np.float64], small: float) -> int | None:
    """After how many frames a residual is as small as asked and stays so; None where it is not.

    The first residual is that of the frame before, so that none is needed where it is small.
    """
    large = np.flatnonzero(~(np.asarray(residual) <= small))
    after = int(large[-1]) + 1 if len(large) else 0
    return after if after < len(residual) else None
