"""Times of functions in turn."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np

C = TypeVar("C")


def time_in_turn(
    work: Mapping[str, Callable[[Any], object]],
    count: int,
    uncounted: int,
    *,
    prepare: Callable[[int], Any] = int,
) -> dict[str, float]:
    """Return the median processor time (ms) of each function, called in turn on a noisy machine.

    Args:
        work: functions by name.
        count: number of calls of each.
        uncounted: number of first calls that do not count, since they may compile.
        prepare: makes the argument from the call's number; its time does not count.
    """
    found: dict[str, list[float]] = {name: [] for name in work}
    for k in range(count):
        for name, function in work.items():
            argument = prepare(k)
            began = time.thread_time()
            function(argument)
            found[name].append(1e3 * (time.thread_time() - began))
    return {name: float(np.median(ms[uncounted:])) for name, ms in found.items()}
