"""What the nodes of one context share: arguments, domain, the DDS participant, who is waiting."""

import os
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from threading import RLock

from ..graph import Graph, GraphNode
from ..transport import DdsError, Participant
from ._arguments import Arguments
from ._rclpy_pybind11 import RCLError
from ._wake_up import WakeUp

__all__ = ["ContextHandle", "LocalNode"]


@dataclass(eq=False)
class LocalNode:
    """What others learn about a node of this process: its name, its readers and its writers."""

    name: str
    namespace: str
    readers: list[bytes] = field(default_factory=list)
    writers: list[bytes] = field(default_factory=list)


class ContextHandle:
    """The state behind a Context that was initialised.

    `invalidate` may be called from a signal handler: it takes no lock. Everything else may not.
    """

    def __init__(self, arguments: Arguments, domain_id: int | None) -> None:
        self._valid = True
        self._waiting: tuple[weakref.ReferenceType[WakeUp], ...] = ()
        self._nodes: list[LocalNode] = []
        self._postponing = 0
        self._lock = RLock()
        self.arguments = arguments
        self.domain_id = _domain_from_environment() if domain_id is None else domain_id
        try:
            self.participant = Participant(self.domain_id, arguments.enclave)
        except DdsError as error:
            raise RCLError(f"failed to initialize rcl: {error}") from None
        self.graph = Graph(self.participant)

    def ok(self) -> bool:
        return self._valid

    def get_domain_id(self) -> int:
        return self.domain_id

    def invalidate(self) -> None:
        """Mark the context as shut down and wake whoever waits on its behalf."""
        self._valid = False
        self.wake_all()

    def wake_all(self) -> None:
        """Wake every executor of this context; they look at everything anew."""
        for reference in self._waiting:
            waiting = reference()
            if waiting is not None:
                waiting.wake()

    def register(self, waiting: WakeUp) -> None:
        """Have something woken by `wake_all` for as long as it exists."""
        with self._lock:  # the tuple is replaced, never changed: a signal may read it at any time
            alive = tuple(reference for reference in self._waiting if reference() is not None)
            self._waiting = (*alive, weakref.ref(waiting))

    def add_node(self, node: LocalNode) -> None:
        """Have a node known to others."""
        with self._lock:
            self._nodes.append(node)
        self.announce()

    def remove_node(self, node: LocalNode) -> None:
        """The counterpart of `add_node`."""
        with self._lock:
            if node in self._nodes:
                self._nodes.remove(node)
        self.announce()

    @contextmanager
    def announced_once(self) -> Iterator[None]:
        """Tell others about many changes together, at the end of a with block."""
        with self._lock:
            self._postponing += 1
        try:
            yield
        finally:
            with self._lock:
                self._postponing -= 1
            self.announce()

    def announce(self) -> None:
        """Tell others which nodes there are, and with which endpoints."""
        with self._lock:
            if not self._postponing:
                self.graph.announce(
                    GraphNode(node.namespace, node.name, tuple(node.readers), tuple(node.writers))
                    for node in self._nodes
                )

    def close(self) -> None:
        """Leave the network. What the nodes still hold does nothing from now on."""
        self.graph.close()
        self.participant.close()

    def __del__(self) -> None:
        if hasattr(self, "graph"):  # the domain could be joined
            self.close()


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
