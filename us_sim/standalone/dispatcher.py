"""One thread per participant that says when something happened to its readers and writers.

A Cyclone listener would run Python on the thread that receives for the whole process, and stall it
whenever the interpreter's lock is held elsewhere. A wait set costs one more thread switch (some
30 µs) and leaves DDS alone; at exit, the thread is blocked in C and simply ends with the process.
"""

from __future__ import annotations

import ctypes as ct
import logging
import threading
from collections.abc import Callable
from itertools import count

from us_sim.standalone.ddsc import INFINITY, check, lib

__all__ = ["Dispatcher"]

_STOP = 0
_AT_ONCE = 64


class Dispatcher:
    """Calls the handlers of entities whose status changed, from its own thread."""

    def __init__(self, participant: int) -> None:
        """Start waiting; ``participant`` is the C handle of the DDS participant."""
        self._waitset = check(lib.dds_create_waitset(participant), "no wait set can be made")
        self._stop = check(lib.dds_create_guardcondition(participant), "no condition can be made")
        lib.dds_waitset_attach(self._waitset, self._stop, _STOP)
        self._tokens = count(_STOP + 1)
        self._handlers: dict[int, Callable[[], None]] = {}
        self._thread = threading.Thread(target=self._run, name="us_sim DDS", daemon=True)
        self._thread.start()

    def attach(self, entity: int, status_mask: int, handler: Callable[[], None]) -> int:
        """Call ``handler`` whenever one of these status bits is set; returns a token."""
        token = next(self._tokens)
        self._handlers[token] = handler
        check(lib.dds_set_status_mask(entity, status_mask), "the endpoint is closed")
        check(lib.dds_waitset_attach(self._waitset, entity, token), "the endpoint is closed")
        return token

    def detach(self, token: int) -> None:
        """Call this token's handler no more (deleting the entity ends the waiting for it)."""
        self._handlers.pop(token, None)

    def close(self) -> None:
        """End the thread, and wait for the handler it is in unless that one is the caller."""
        self._handlers.clear()
        lib.dds_set_guardcondition(self._stop, True)
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _run(self) -> None:
        tokens = (ct.c_ssize_t * _AT_ONCE)()
        while True:
            triggered = lib.dds_waitset_wait(self._waitset, tokens, _AT_ONCE, INFINITY)
            if triggered < 0:
                return
            for token in tokens[: min(triggered, _AT_ONCE)]:
                if token == _STOP:
                    return
                handler = self._handlers.get(token)
                if handler is None:
                    continue
                try:
                    handler()
                except Exception:
                    logging.getLogger(__name__).exception("a callback of the transport failed")
