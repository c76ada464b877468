"""An OpenIGTLink server that sends each client the newest messages and never waits for one.

>>> from us_sim.tracking.openigtlink.server import OpenIGTLinkServer
>>> server = OpenIGTLinkServer("localhost", 0)
>>> server.send("ProbeToReference", b"...")
>>> server.clients
0
>>> server.close()
"""

from __future__ import annotations

import contextlib
import selectors
import socket
import threading
from dataclasses import dataclass, field

from us_sim.errors import TrackingError

_MOST_CLIENTS = 16
_READ_AT_ONCE = 1 << 16


@dataclass(eq=False)
class _Client:
    """A connection, the message being sent, and the newest of each name that wait."""

    connection: socket.socket
    underway: memoryview = field(default_factory=lambda: memoryview(b""))
    waiting: dict[str, bytes] = field(default_factory=dict)


class OpenIGTLinkServer:
    """A thread that sends the newest message of each name to every client.

    A client that is too slow for all messages gets the newest ones; what a client sends is not
    listened to.

    Args:
        host: name or address to listen at; an empty text for every one this computer has.
        port: TCP port; 0 for any that is free, see `port`.

    Raises:
        TrackingError: it cannot listen there.
    """

    def __init__(self, host: str, port: int) -> None:
        try:
            self._listener = socket.create_server((host, port))
        except OSError as error:
            raise TrackingError(
                f"cannot serve OpenIGTLink at {host or 'every address'}, port {port} "
                f"({error.strerror or error}): end what uses the port, or choose another"
            ) from error
        self.port = int(self._listener.getsockname()[1])
        self._clients: dict[socket.socket, _Client] = {}
        self._lock = threading.Lock()
        self._closing = False
        self._selector = selectors.DefaultSelector()
        self._bell, self._ear = socket.socketpair()
        for listening in (self._listener, self._ear, self._bell):
            listening.setblocking(False)
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._selector.register(self._ear, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._run, name="openigtlink", daemon=True)
        self._thread.start()

    @property
    def clients(self) -> int:
        """Number of clients connected."""
        return len(self._clients)

    def send(self, name: str, message: bytes) -> None:
        """Send a message to all clients; one of the same name that has not left yet is dropped."""
        with self._lock:
            for client in self._clients.values():
                client.waiting[name] = message
        self._ring()

    def close(self) -> None:
        """Disconnect all, and wait for the thread to end."""
        self._closing = True
        self._ring()
        self._thread.join()
        for end in (self._ear, self._bell):  # not by the thread, which may be done before the ring
            end.close()

    def _ring(self) -> None:
        with contextlib.suppress(BlockingIOError):  # it has been rung often enough already
            self._bell.send(b"\0")

    def _run(self) -> None:
        while not self._closing:
            for key, events in self._selector.select():
                if key.fileobj is self._ear:
                    self._ear.recv(_READ_AT_ONCE)
                elif key.fileobj is self._listener:
                    self._accept()
                else:
                    self._serve(key.data, events)
            for client in list(self._clients.values()):
                if client.waiting and not client.underway:
                    self._serve(client, selectors.EVENT_WRITE)
        for client in list(self._clients.values()):
            self._drop(client)
        self._selector.close()
        self._listener.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):  # gone again already
            connection, _ = self._listener.accept()
            if len(self._clients) >= _MOST_CLIENTS:
                connection.close()
                return
            connection.setblocking(False)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            client = _Client(connection)
            self._selector.register(connection, selectors.EVENT_READ, client)
            with self._lock:
                self._clients[connection] = client

    def _serve(self, client: _Client, events: int) -> None:
        """Read what is not listened to, and send what the connection takes."""
        if client.connection not in self._clients:
            return
        try:
            if events & selectors.EVENT_READ and not client.connection.recv(_READ_AT_ONCE):
                self._drop(client)
                return
            if events & selectors.EVENT_WRITE:
                self._write(client)
        except BlockingIOError:
            pass
        except OSError:
            self._drop(client)
            return
        wanted = selectors.EVENT_READ | (selectors.EVENT_WRITE if client.underway else 0)
        self._selector.modify(client.connection, wanted, client)

    def _write(self, client: _Client) -> None:
        """Raises BlockingIOError when the connection takes no more."""
        while True:
            if not client.underway:
                with self._lock:
                    if not client.waiting:
                        return
                    name = next(iter(client.waiting))
                    client.underway = memoryview(client.waiting.pop(name))
            sent = client.connection.send(client.underway)
            client.underway = client.underway[sent:]

    def _drop(self, client: _Client) -> None:
        with self._lock:
            del self._clients[client.connection]
        self._selector.unregister(client.connection)
        client.connection.close()
