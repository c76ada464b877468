"""Contexts, each with its own arguments, domain and life; the default one; and signals.

As in rclpy, SIGINT shuts all contexts down and also does what Python does (KeyboardInterrupt in the
main thread), while SIGTERM ends nothing by itself: `spin` raises ExternalShutdownException.
"""

import _thread
import math
import os
import signal
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from enum import Enum
from inspect import ismethod
from threading import RLock
from types import FrameType
from typing import Any

from ..middleware import GraphNode, MiddlewareError, connect, implementation
from ._arguments import parse_arguments
from .exceptions import NotInitializedException, RCLError
from .logging import configure, get_logger, release

_logger = get_logger("rclpy")


_MISSED_S = 0.5
"""After which a wait looks for signals: Python sees one that came right before it only then."""


class WakeUp:
    """One thread waits; any thread or signal handler wakes it, now or for its next wait.

    `threading.Event` takes a lock inside `set()`, so a handler that interrupts the waiting thread
    at the wrong moment would wait for itself. Releasing a bare lock never blocks.
    """

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
        end = math.inf if timeout is None else time.monotonic() + timeout
        while not self._lock.acquire(True, min(max(end - time.monotonic(), 0.0), _MISSED_S)):
            if time.monotonic() >= end:
                return False
        return True


class SignalHandlerOptions(Enum):
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


Callback = Callable[[], None]


class Context(AbstractContextManager["Context"]):
    """Encapsulates the life of init and shutdown. Used as a context manager it inits itself."""

    def __init__(self) -> None:
        self._lock = RLock()
        self._callbacks: list[weakref.WeakMethod[Callback] | Callback] = []
        self._initialized = self._valid = self._logging_initialized = False
        self._waiting: tuple[weakref.ReferenceType[WakeUp], ...] = ()
        self._nodes: dict[object, GraphNode] = {}  # of this context, by keys of their own
        self._postponing = 0

    def init(
        self,
        args: list[str] | None = None,
        *,
        initialize_logging: bool = True,
        domain_id: int | None = None,
    ) -> None:
        with self._lock:
            if domain_id is not None and domain_id < 0:
                raise RuntimeError(f"Domain id ({domain_id}) should not be lower than zero.")
            if self._initialized:
                raise RuntimeError("Context.init() must only be called once")
            _refuse_security()
            self._arguments = parse_arguments(sys.argv if args is None else args)
            self._domain_id = _domain_from_environment() if domain_id is None else domain_id
            try:
                self._middleware = connect(self._domain_id, self._arguments.enclave)
            except MiddlewareError as error:
                raise RCLError(f"failed to initialize rcl: {error}") from None
            self._initialized = self._valid = True
            add_context(self)
            if initialize_logging:
                configure(self._arguments)
                self._logging_initialized = True

    def ok(self) -> bool:
        return self._valid

    def get_domain_id(self) -> int:
        if not self._initialized:
            raise RuntimeError("Context must be initialized before it can have a domain id")
        return self._domain_id

    def shutdown(self) -> None:
        if not self._initialized:
            raise RuntimeError("Context must be initialized before it can be shutdown")
        was_ok = self._valid
        self.try_shutdown()
        if not was_ok:
            raise RCLError("failed to shutdown: rcl_shutdown already called on the given context")

    def try_shutdown(self) -> None:
        """As `shutdown`, but without an error when it already happened."""
        if not self._initialized:
            return
        remove_context(self)
        self._invalidate()
        with self._lock:
            callbacks, self._callbacks = self._callbacks, []
            logging_initialized, self._logging_initialized = self._logging_initialized, False
        for entry in callbacks:
            callback = entry() if isinstance(entry, weakref.WeakMethod) else entry
            if callback is not None:
                callback()
        self.destroy()
        if logging_initialized:
            release()

    def destroy(self) -> None:
        """Leave the network; endpoints that nodes still hold do nothing from now on."""
        if self._initialized:
            self._middleware.close()

    __del__ = destroy

    def on_shutdown(self, callback: Callback) -> None:
        """Have something called when this context is shut down; at once if it already was.

        A bound method does not keep its object alive.
        """
        if not callable(callback):
            raise TypeError("callback should be a callable, got {}", type(callback))
        with self._lock:
            if self._valid or not self._initialized:
                if ismethod(callback):
                    self._callbacks.append(weakref.WeakMethod(callback, self._forget))
                else:
                    self._callbacks.append(callback)
                return
        callback()

    def _forget(self, method: "weakref.WeakMethod[Callback]") -> None:
        if method in self._callbacks:
            self._callbacks.remove(method)

    def __enter__(self) -> "Context":
        self.init()
        return self

    def __exit__(self, *_: object) -> None:
        self.try_shutdown()

    def _require_init(self, thing: str) -> None:
        if not self._initialized:
            raise NotInitializedException(f"cannot create {thing}")

    def _invalidate(self) -> None:
        """Mark the context as shut down and wake whoever waits on its behalf.

        A signal handler may call this: it takes no lock. Everything else may.
        """
        self._valid = False
        self._wake_all()

    def _wake_all(self) -> None:
        """Wake every executor of this context; they look at everything anew."""
        for reference in self._waiting:
            waiting = reference()
            if waiting is not None:
                waiting.wake()

    def _register(self, waiting: WakeUp) -> None:
        """Have something woken by `_wake_all` for as long as it exists."""
        with self._lock:  # the tuple is replaced, never changed: a signal may read it at any time
            alive = tuple(reference for reference in self._waiting if reference() is not None)
            self._waiting = (*alive, weakref.ref(waiting))

    def _set_node(self, key: object, node: GraphNode | None) -> None:
        """Have a node known to others as it is now, or no more."""
        with self._lock:
            if node == self._nodes.get(key):
                return
            if node is None:
                del self._nodes[key]
            else:
                self._nodes[key] = node
            self._announce()

    @contextmanager
    def _announced_once(self) -> Iterator[None]:
        """Tell others about many changes together, at the end of a with block."""
        with self._lock:
            self._postponing += 1
        try:
            yield
        finally:
            with self._lock:
                self._postponing -= 1
            self._announce()

    def _announce(self) -> None:
        """Tell others which nodes there are, and with which endpoints."""
        with self._lock:
            if not self._postponing:
                self._middleware.announce(self._nodes.values())


def _refuse_security() -> None:
    """Raise RCLError where the environment asks for encryption, which no transport here has.

    With ROS_SECURITY_STRATEGY=Permissive a node of ROS that has no keys speaks in the clear, so
    nodes here do, too. ROS takes that also where the variable is not set; here it has to be said.
    """
    if os.environ.get("ROS_SECURITY_ENABLE") != "true":
        return
    if os.environ.get("ROS_SECURITY_STRATEGY") == "Permissive":
        _logger.warning(
            "ROS_SECURITY_ENABLE is true, but without ROS 2 there is no DDS security: as "
            "ROS_SECURITY_STRATEGY is Permissive, everything is sent in the clear",
            once=True,
        )
        return
    raise RCLError(
        "failed to initialize rcl: ROS_SECURITY_ENABLE is true, but without ROS 2 there is no DDS "
        "security: install ROS 2; or, to send everything in the clear, unset ROS_SECURITY_ENABLE "
        "or set ROS_SECURITY_STRATEGY=Permissive"
    )


def _domain_from_environment() -> int:
    text = os.environ.get("ROS_DOMAIN_ID", "").strip()
    if not text:
        return 0
    if not text.isdecimal() or int(text) > 232:
        raise RCLError(
            f"failed to initialize rcl: ROS_DOMAIN_ID is '{text}' in the environment, "
            "but it has to be a whole number from 0 to 232"
        )
    return int(text)


_default_context: Context | None = None
_lock = threading.RLock()


def get_default_context(*, shutting_down: bool = False) -> Context:
    """The context that is used where none is given; forgotten when it is shutting down."""
    global _default_context
    with _lock:
        context = Context() if _default_context is None else _default_context
        _default_context = None if shutting_down else context
        return context


def ok(*, context: Context | None = None) -> bool:
    return (get_default_context() if context is None else context).ok()


def shutdown(*, context: Context | None = None) -> None:
    (get_default_context(shutting_down=True) if context is None else context).shutdown()


def try_shutdown(*, context: Context | None = None) -> None:
    """Shut a context down if it is up."""
    (get_default_context(shutting_down=True) if context is None else context).try_shutdown()


def remove_ros_args(args: Sequence[str] | None = None) -> list[str]:
    """A command line (`sys.argv` when None) without the part between --ros-args and --."""
    return list(parse_arguments(sys.argv if args is None else args).others)


def get_rmw_implementation_identifier() -> str:
    """Which middleware this speaks."""
    try:
        return implementation()
    except MiddlewareError as error:
        raise RCLError(str(error)) from None
