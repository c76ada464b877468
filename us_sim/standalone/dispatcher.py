"""One thread per participant that says when something happened to its readers and writers.

A Cyclone listener would run Python on the thread that receives for the whole process, and stall it
whenever the interpreter's lock is held elsewhere. A wait set costs one more thread switch (some
30 µs) and leaves DDS alone; at exit, the thread is blocked in C and simply ends with the process.
"""

from __future__ import annotations

import ctypes as ct
import logging
import threading
from collections import deque
from collections.abc import Callable
from itertools import count

from .ddsc import INFINITY, check, lib

_WAKE_UP = 0
_AT_ONCE = 64


class Dispatcher:
    """Calls the handlers of entities whose status changed, always from its own thread."""

    def __init__(self, participant: int) -> None:
        """Start waiting; ``participant`` is the C handle of the DDS participant."""
        self._waitset = check(lib.dds_create_waitset(participant), "no wait set can be made")
        self._wake_up = check(
            lib.dds_create_guardcondition(participant), "no condition can be made"
        )
        lib.dds_waitset_attach(self._waitset, self._wake_up, _WAKE_UP)
        self._closed = False
        self._soon: deque[Callable[[], None]] = deque()
        self._tokens = count(_WAKE_UP + 1)
        self._handlers: dict[int, Callable[[], None]] = {}
        self._thread = threading.Thread(target=self._run, name="DDS dispatcher", daemon=True)
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

    def call_soon(self, handler: Callable[[], None]) -> None:
        """Call ``handler`` once."""
        self._soon.append(handler)
        lib.dds_set_guardcondition(self._wake_up, True)

    def close(self) -> None:
        """End the thread, giving the handler that it may be in a second to finish."""
        self._closed = True
        lib.dds_set_guardcondition(self._wake_up, True)
        if threading.current_thread() is not self._thread:
            # Not for ever: the handler may wait for a lock that the caller holds.
            self._thread.join(timeout=1.0)

    def _run(self) -> None:
        tokens = (ct.c_ssize_t * _AT_ONCE)()
        was_set = ct.c_bool()
        while not self._closed:
            triggered = lib.dds_waitset_wait(self._waitset, tokens, _AT_ONCE, INFINITY)
            if triggered < 0:
                return
            for token in tokens[: min(triggered, _AT_ONCE)]:
                if token != _WAKE_UP:
                    self._call(self._handlers.get(token))
                    continue
                lib.dds_take_guardcondition(self._wake_up, ct.byref(was_set))
                while self._soon:
                    self._call(self._soon.popleft())

    def _call(self, handler: Callable[[], None] | None) -> None:
        if handler is None or self._closed:
            return
        try:
            handler()
        except Exception:
            logging.getLogger(__name__).exception("a callback of the transport failed")
