"""The address at which the page is served: taken, or refused with a sentence."""

from __future__ import annotations

import contextlib
import errno
import socket

from us_sim.errors import UsSimError

_QUEUE = 64


def require_free(host: str, port: int) -> None:
    """Raise UsSimError when nobody can listen there now."""
    listening(host, port).close()


def listening(host: str, port: int) -> socket.socket:
    """A socket that listens there.

    Raises:
        UsSimError: it cannot.
    """
    try:
        family, kind, protocol, _, where = socket.getaddrinfo(
            host or None, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        opened = socket.socket(family, kind, protocol)
    except OSError as error:
        raise UsSimError(
            f"--host {host}: {error.strerror or error}; give an address of this computer"
        ) from error
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        opened.bind(where)
        opened.listen(_QUEUE)
    except OSError as error:
        with contextlib.suppress(OSError):
            opened.close()
        if error.errno == errno.EADDRINUSE:
            raise UsSimError(
                f"port {port} of {host} is taken: choose another with --port, or 0 for any that "
                f"is free"
            ) from error
        raise UsSimError(
            f"{host}:{port} cannot be listened at: {error.strerror}; choose another --host or "
            f"--port"
        ) from error
    return opened
