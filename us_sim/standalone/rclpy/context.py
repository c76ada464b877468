"""Contexts: several can exist in one process, each with its own arguments, domain and life.

>>> with Context() as context:
...     context.ok()
True
>>> context.ok()
False
"""

import sys
import weakref
from collections.abc import Callable
from contextlib import AbstractContextManager
from inspect import ismethod
from operator import attrgetter
from threading import RLock

from . import _logging_outputs, signals
from ._arguments import parse_arguments
from ._context_handle import ContextHandle
from ._rclpy_pybind11 import RCLError

__all__ = ["Context"]

Callback = Callable[[], None]


class Context(AbstractContextManager["Context"]):
    """Encapsulates the life of init and shutdown. Used as a context manager it inits itself."""

    handle = property(attrgetter("_handle"))

    def __init__(self) -> None:
        self._lock = RLock()
        self._callbacks: list[weakref.WeakMethod[Callback] | Callback] = []
        self._handle: ContextHandle | None = None
        self._logging_initialized = False

    def init(
        self,
        args: list[str] | None = None,
        *,
        initialize_logging: bool = True,
        domain_id: int | None = None,
    ) -> None:
        """Start this context's life."""
        with self._lock:
            if domain_id is not None and domain_id < 0:
                raise RuntimeError(f"Domain id ({domain_id}) should not be lower than zero.")
            if self._handle is not None:
                raise RuntimeError("Context.init() must only be called once")
            arguments = parse_arguments(sys.argv if args is None else args)
            self._handle = ContextHandle(arguments, domain_id)
            signals.add_context(self._handle)
            if initialize_logging:
                _logging_outputs.configure(arguments)
                self._logging_initialized = True

    def ok(self) -> bool:
        """Whether this context was initialised and not yet shut down."""
        handle = self._handle
        return handle is not None and handle.ok()

    def get_domain_id(self) -> int:
        """The DDS domain that this context is in."""
        if self._handle is None:
            raise RuntimeError("Context must be initialized before it can have a domain id")
        return self._handle.get_domain_id()

    def shutdown(self) -> None:
        """End this context's life: executors stop, and everything leaves the network."""
        if self._handle is None:
            raise RuntimeError("Context must be initialized before it can be shutdown")
        was_ok = self._handle.ok()
        self._end(self._handle)
        if not was_ok:
            raise RCLError("failed to shutdown: rcl_shutdown already called on the given context")

    def try_shutdown(self) -> None:
        """As `shutdown`, but without an error when it already happened."""
        if self._handle is not None:
            self._end(self._handle)

    def _end(self, handle: ContextHandle) -> None:
        signals.remove_context(handle)
        handle.invalidate()
        with self._lock:
            callbacks, self._callbacks = self._callbacks, []
            logging_initialized, self._logging_initialized = self._logging_initialized, False
        for entry in callbacks:
            callback = entry() if isinstance(entry, weakref.WeakMethod) else entry
            if callback is not None:
                callback()
        handle.close()
        if logging_initialized:
            _logging_outputs.release()

    def destroy(self) -> None:
        """Release what this context holds."""
        if self._handle is not None:
            self._handle.close()

    def on_shutdown(self, callback: Callback) -> None:
        """Have something called when this context is shut down; at once if it already was.

        A bound method does not keep its object alive.
        """
        if not callable(callback):
            raise TypeError("callback should be a callable, got {}", type(callback))
        with self._lock:
            if self._handle is None or self._handle.ok():
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
