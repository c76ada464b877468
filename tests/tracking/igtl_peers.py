"""The other side of an OpenIGTLink connection: pyigtl's, and one that sends what it is told."""

from __future__ import annotations

import contextlib
import signal
import socket
import time
from collections.abc import Callable, Iterator
from typing import Any

import pyigtl


@contextlib.contextmanager
def pyigtl_server(port: int = 0) -> Iterator[Any]:
    """pyigtl's server on localhost; it takes signals for itself, which are given back."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    server = pyigtl.OpenIGTLinkServer(port=port)
    try:
        yield server
    finally:
        server.stop()
        for number, handler in handlers.items():
            signal.signal(number, handler)


def free_port() -> int:
    """One that nobody listens on just now."""
    with socket.create_server(("localhost", 0)) as probe:
        return int(probe.getsockname()[1])


def wait_until(condition: Callable[[], bool], limit: float = 20.0) -> None:
    """Fail after ``limit`` seconds."""
    deadline = time.monotonic() + limit
    while not condition():
        assert time.monotonic() < deadline, "what the test waits for did not happen"
        time.sleep(0.002)


class PlainServer:
    """A server for one client after another that sends the bytes it is given."""

    def __init__(self) -> None:
        self._listener = socket.create_server(("localhost", 0))
        self.port = int(self._listener.getsockname()[1])
        self.connection: socket.socket | None = None

    def accept(self) -> socket.socket:
        """Wait for the next client."""
        self._listener.settimeout(20.0)
        self.connection, _ = self._listener.accept()
        return self.connection

    def close(self) -> None:
        """End the connection and listen no more."""
        if self.connection is not None:
            self.connection.close()
        self._listener.close()
