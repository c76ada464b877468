"""How long a frame of the tissue may take, so that the poses of a tracker are kept up with.

>>> from us_sim.tissue.solvers.frame_budget import frame_limit
>>> f"{1e3 * frame_limit(sending=0.0005, cores=2):.1f} ms"
'14.0 ms'
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable

_PERIOD = 1 / 60
"""s, between the poses of the trackers that are meant to be kept up with."""

_SHARE, _LONELY_SHARE = 0.87, 0.5
"""What one node may use of a period, the rest being for what else its core does: with two cores or
more, and with one that all nodes share."""

_LEAST = 0.002  # s
_TRIES = 5


def frame_limit(sending: float, cores: int) -> float:
    """s, that a frame may take.

    Args:
        sending: s, that it takes to send its result.
        cores: that the nodes of the simulation share.
    """
    share = _SHARE if cores > 1 else _LONELY_SHARE
    return max(share * _PERIOD - sending, _LEAST)


def usable_cores() -> int:
    """The cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def shortest(work: Callable[[], object]) -> float:
    """s, on the wall, of the shortest of a few runs of ``work``."""
    times = []
    for _ in range(_TRIES):
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
    return min(times)
