"""Work that is done at a steady rate beside the executor, which only takes messages."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections import deque
from collections.abc import Callable

import numpy as np

_MEASURED = 2000
"""Ticks of which the jitter is told."""

_PRIORITY = 20
"""Among real-time threads: ordinary ones are at 0, the kernel's at 50."""


class PeriodicThread:
    """Calls ``work`` at absolute times one period apart; those that have passed are skipped.

    Args:
        rate: Hz.
        work: what to do, with the time in ns of the monotonic clock; it must not raise.
    """

    def __init__(self, rate: float, work: Callable[[int], None]) -> None:
        self._period = round(1e9 / rate)
        self._work = work
        self._ending = threading.Event()
        self._late: deque[int] = deque(maxlen=_MEASURED)  # ns
        self.skipped = 0
        self._thread = threading.Thread(target=self._run, name="periodic", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """End after the present tick."""
        self._ending.set()
        if self._thread.is_alive():
            self._thread.join()

    @property
    def jitter(self) -> float:
        """s, by which 99 of 100 of the last ticks' work was done later than the period after the
        one before, or earlier, at most."""
        late = np.array(self._late)
        return 1e-9 * float(np.percentile(np.abs(np.diff(late)), 99)) if len(late) > 1 else 0.0

    def _run(self) -> None:
        be_punctual()
        due = time.monotonic_ns()
        while not self._ending.is_set():
            due += self._period
            wait = due - time.monotonic_ns()
            if wait > 0:
                time.sleep(1e-9 * wait)
            elif wait < -self._period:
                passed = -wait // self._period
                self.skipped += passed
                due += passed * self._period
            self._work(time.monotonic_ns())
            self._late.append(time.monotonic_ns() - due)


def be_punctual(priority: int = _PRIORITY) -> None:
    """Let this thread run before the machine's other ones, where the system allows that."""
    with contextlib.suppress(AttributeError, OSError):
        os.sched_setscheduler(threading.get_native_id(), os.SCHED_FIFO, os.sched_param(priority))
