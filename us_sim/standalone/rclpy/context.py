"""Contexts: several can exist in one process, each with its own arguments, domain and life.

>>> with Context() as context:
...     context.ok()
True
>>> context.ok()
False
"""

import os
import sys
import weakref
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from inspect import ismethod
from threading import RLock

from ..graph import Graph, GraphNode
from ..transport import DdsError, Participant
from . import _logging_outputs, signals
from ._arguments import parse_arguments
from ._rclpy_pybind11 import RCLError
from ._wake_up import WakeUp
from .exceptions import NotInitializedException

Callback = Callable[[], None]


@dataclass(eq=False)
class LocalNode:
    """What others learn about a node of this process: its name, its readers and its writers."""

    name: str
    namespace: str
    readers: list[bytes] = field(default_factory=list)
    writers: list[bytes] = field(default_factory=list)


class Context(AbstractContextManager["Context"]):
    """Encapsulates the life of init and shutdown. Used as a context manager it inits itself."""

    def __init__(self) -> None:
        self._lock = RLock()
        self._callbacks: list[weakref.WeakMethod[Callback] | Callback] = []
        self._initialized = self._valid = self._logging_initialized = False
        self._waiting: tuple[weakref.ReferenceType[WakeUp], ...] = ()
        self._nodes: list[LocalNode] = []
        self._postponing = 0

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
            if self._initialized:
                raise RuntimeError("Context.init() must only be called once")
            self._arguments = parse_arguments(sys.argv if args is None else args)
            self._domain_id = _domain_from_environment() if domain_id is None else domain_id
            try:
                self._participant = Participant(self._domain_id, self._arguments.enclave)
            except DdsError as error:
                raise RCLError(f"failed to initialize rcl: {error}") from None
            self._graph = Graph(self._participant)
            self._initialized = self._valid = True
            signals.add_context(self)
            if initialize_logging:
                _logging_outputs.configure(self._arguments)
                self._logging_initialized = True

    def ok(self) -> bool:
        """Whether this context was initialised and not yet shut down."""
        return self._valid

    def get_domain_id(self) -> int:
        """The DDS domain that this context is in."""
        if not self._initialized:
            raise RuntimeError("Context must be initialized before it can have a domain id")
        return self._domain_id

    def shutdown(self) -> None:
        """End this context's life: executors stop, and everything leaves the network."""
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
        signals.remove_context(self)
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
            _logging_outputs.release()

    def destroy(self) -> None:
        """Leave the network. What the nodes still hold does nothing from now on."""
        if self._initialized:
            self._graph.close()
            self._participant.close()

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

    def _require_init(self, what: str) -> None:
        if not self._initialized:
            raise NotInitializedException(f"cannot create {what}")

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

    def _add_node(self, node: LocalNode) -> None:
        """Have a node known to others."""
        with self._lock:
            self._nodes.append(node)
        self._announce()

    def _remove_node(self, node: LocalNode) -> None:
        """The counterpart of `_add_node`."""
        with self._lock:
            if node in self._nodes:
                self._nodes.remove(node)
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
                self._graph.announce(
                    GraphNode(node.namespace, node.name, tuple(node.readers), tuple(node.writers))
                    for node in self._nodes
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
