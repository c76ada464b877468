"""A binary semaphore that a signal handler may raise.

`threading.Event` takes a lock inside `set()`, so a handler that interrupts the waiting thread at
the wrong moment would wait for itself. Releasing a bare lock never blocks.
"""

import _thread
from threading import TIMEOUT_MAX


class WakeUp:
    """One thread waits; any thread or signal handler wakes it, now or for its next wait."""

    __slots__ = ("__weakref__", "_lock")

    def __init__(self) -> None:
        self._lock = _thread.allocate_lock()
        self._lock.acquire()

    def wake(self) -> None:
        """End the current wait, or the next one if nobody waits."""
        if self._lock.locked():
            try:  # noqa: SIM105 (this runs for every message)
                self._lock.release()
            except RuntimeError:
                pass  # somebody else woke it in between

    def wait(self, timeout: float | None = None) -> bool:
        """Wait for `wake`; False after `timeout` seconds without."""
        if timeout is None:
            return self._lock.acquire()
        return self._lock.acquire(True, min(max(timeout, 0.0), TIMEOUT_MAX))
