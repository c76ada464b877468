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
