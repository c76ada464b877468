"""Processes that end with the one that started them, whatever happens to that (Linux alone)."""

from __future__ import annotations

import ctypes
import signal

_PR_SET_PDEATHSIG = 1
_THIS_PROGRAM = ctypes.CDLL(None)


def end_with_parent() -> None:
    """Called in a new process before its program begins."""
    _THIS_PROGRAM.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
