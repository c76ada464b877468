"""The web server of the viewer, in a thread of its own."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import secrets
import socket
import threading
import time
from typing import TYPE_CHECKING, Any

from us_sim.cache import cache_folder
from us_sim.errors import UsSimError
from us_sim.viewer.access import AccessControl, is_loopback

if TYPE_CHECKING:  # `us_sim.run.plan` asks for a free port where there is no rclpy
    from us_sim.viewer.stream import PageSources


def require_free_address(host: str, port: int) -> None:
    """Raise UsSimError if nobody can listen at the address now."""
    open_socket(host, port).close()


def open_socket(host: str, port: int) -> socket.socket:
    """Open a socket that listens at the address.

    Raises:
        UsSimError: the address is none of this computer, or taken.
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
        opened.listen(64)
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


class WebServer:
    """Serves the page, in a thread of its own, until it is closed.

    Args:
        sources: what the page shows.
        host: address to listen at; other computers need a token.
        port: of TCP; 0 takes any free one.
        token: the token; "" makes a new one.

    Raises:
        UsSimError: NiceGUI is not installed, the address cannot be listened at, or the token is
            easily guessed or cannot stand in an address.
    """

    def __init__(
        self, sources: PageSources, host: str = "127.0.0.1", port: int = 8080, token: str = ""
    ) -> None:
        self.token = "" if is_loopback(host) else _check_token(token) or secrets.token_urlsafe(16)
        self._uvicorn, application = _import_server(sources)
        self._socket = open_socket(host, port)
        self.host, self.port = host, int(self._socket.getsockname()[1])
        config = self._uvicorn.Config(
            AccessControl(application, self.token),
            log_level="warning",
            ws_per_message_deflate=False,  # it costs more time than it saves on one computer
            ws_max_size=2**20,
            timeout_graceful_shutdown=1,
        )
        self._server = self._uvicorn.Server(config)
        self._thread = threading.Thread(target=self._run, name="web server", daemon=True)
        self._thread.start()
        self._await_start()

    @property
    def addresses(self) -> tuple[str, ...]:
        """All URLs for a person to open.

        For a server that listens at every address they have this computer's name, and its IP
        address in the network, as other computers may not know the name.
        """
        hosts = [self.host]
        if self.host in ("0.0.0.0", "::", ""):
            hosts = [socket.gethostname(), *_find_own_address()]
        token = f"?token={self.token}" if self.token else ""
        shown = (f"[{host}]" if ":" in host else host for host in hosts)
        return tuple(f"http://{host}:{self.port}/{token}" for host in shown)

    def close(self) -> None:
        """Stop the server."""
        self._server.should_exit = True
        self._thread.join(3.0)
        self._socket.close()

    def _run(self) -> None:
        self._server.run(sockets=[self._socket])

    def _await_start(self) -> None:
        until = time.monotonic() + 30.0
        while self._thread.is_alive() and time.monotonic() < until:
            if self._server.started:
                return
            time.sleep(0.02)
        raise UsSimError(f"the web server at {self.host}:{self.port} did not start")


def _find_own_address() -> list[str]:
    """Return the IP address from which this computer sends to others; empty without a network."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        try:
            asking.connect(("192.0.2.1", 9))  # an address for examples; nothing is sent
        except OSError:
            return []
        return [str(asking.getsockname()[0])]


def _import_server(sources: PageSources) -> tuple[Any, Any]:
    """Return the module uvicorn, and the application; raise UsSimError if a package is missing."""
    # NiceGUI would make a folder of its own in the working directory.
    os.environ.setdefault("NICEGUI_STORAGE_PATH", str(cache_folder() / "viewer"))
    try:
        import uvicorn

        from us_sim.viewer.page import make_application
    except ImportError as error:
        raise UsSimError(
            f"the viewer needs {error.name}: install it with `pip install 'us_sim[viewer]'`"
        ) from error
    return uvicorn, make_application(sources)


def _check_token(token: str) -> str:
    """Return the token, which may be ""; raise if it is too short or has other characters."""
    if token and not re.fullmatch(r"[A-Za-z0-9_.~-]{16,}", token):
        raise UsSimError(
            "the viewer's token must have 16 letters, digits, or characters of _.~- at least: set "
            "US_SIM_VIEWER_TOKEN to another, or not at all"
        )
    return token
