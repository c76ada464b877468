"""Ctrl-C and SIGTERM: every context is shut down, and executors that spin stop.

As in rclpy, SIGINT also does what Python does (KeyboardInterrupt in the main thread), while
SIGTERM ends nothing by itself: `spin` raises ExternalShutdownException.
"""

import signal
import threading
import weakref
from enum import Enum
from types import FrameType
from typing import Any


class SignalHandlerOptions(Enum):
    """Which signals shut contexts down."""

    NO = 0
    SIGINT = 1
    SIGTERM = 2
    ALL = 3


# Replaced, never changed: a signal handler may read it at any time.
_contexts: tuple[weakref.ReferenceType[Any], ...] = ()
_contexts_lock = threading.Lock()
_previous: dict[int, Any] = {}


def add_context(context: Any) -> None:
    """Have a context shut down by the signals whose handlers are installed."""
    global _contexts
    with _contexts_lock:
        alive = tuple(reference for reference in _contexts if reference() is not None)
        _contexts = (*alive, weakref.ref(context))


def remove_context(context: Any) -> None:
    """Forget a context."""
    global _contexts
    with _contexts_lock:
        _contexts = tuple(
            reference for reference in _contexts if reference() not in (None, context)
        )


def install_signal_handlers(options: SignalHandlerOptions = SignalHandlerOptions.ALL) -> None:
    """Add handlers for the given signals to those that are installed.

    Python takes signals in the main thread only; called from another thread this does nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        return
    for bit, number in ((1, signal.SIGINT), (2, signal.SIGTERM)):
        if options.value & bit and number not in _previous:
            _previous[number] = signal.getsignal(number)
            signal.signal(number, _shut_down_contexts)


def get_current_signal_handlers_options() -> SignalHandlerOptions:
    """Which handlers are installed now."""
    return SignalHandlerOptions((signal.SIGINT in _previous) + 2 * (signal.SIGTERM in _previous))


def uninstall_signal_handlers() -> None:
    """Give back the signals to whoever handled them before."""
    if threading.current_thread() is not threading.main_thread():
        return
    for number in list(_previous):
        previous = _previous.pop(number)
        if signal.getsignal(number) is _shut_down_contexts:
            signal.signal(number, signal.SIG_DFL if previous is None else previous)


def _shut_down_contexts(number: int, frame: FrameType | None) -> None:
    # Nothing here takes a lock: the interrupted code may hold it.
    for reference in _contexts:
        context = reference()
        if context is not None:
            context._invalidate()
    previous = _previous.get(number)
    if callable(previous):
        previous(number, frame)
