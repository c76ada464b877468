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

if TYPE_CHECKING:  # since `us_sim.run.plan` asks for a free port where there is no rclpy
    from us_sim.viewer.stream import Simulator


def require_free_address(host: str, port: int) -> None:
    """Raise UsSimError when nobody can listen there now."""
    open_socket(host, port).close()


def open_socket(host: str, port: int) -> socket.socket:
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
    """Serves the page until it is closed.

    Args:
        simulator: what the page shows.
        host: address to listen at; any but this computer's own needs the token in the address.
        port: TCP; 0 is any that is free.
        token: that one; "" is a new one.

    Raises:
        UsSimError: NiceGUI is not installed, the address cannot be listened at, or the token is
            easily guessed or cannot stand in an address.
    """

    def __init__(
        self, simulator: Simulator, host: str = "127.0.0.1", port: int = 8080, token: str = ""
    ) -> None:
        self.token = "" if is_loopback(host) else _checked(token) or secrets.token_urlsafe(16)
        self._uvicorn, application = _made(simulator)
        self._socket = open_socket(host, port)
        self.host, self.port = host, int(self._socket.getsockname()[1])
        config = self._uvicorn.Config(
            AccessControl(application, self.token),
            log_level="warning",
            ws_per_message_deflate=False,  # it costs more time than this computer's wire
            ws_max_size=2**20,
            timeout_graceful_shutdown=1,
        )
        self._server = self._uvicorn.Server(config)
        self._thread = threading.Thread(target=self._run, name="web server", daemon=True)
        self._thread.start()
        self._await_start()

    @property
    def address(self) -> str:
        """That a person opens."""
        return self.addresses[0]

    @property
    def addresses(self) -> tuple[str, ...]:
        """All that a person may open.

        Where it listens everywhere that is this computer's name, and, since others may not know
        that name, the number by which the network knows the computer.
        """
        hosts = [self.host]
        if self.host in ("0.0.0.0", "::", ""):
            hosts = [socket.gethostname(), *_outward()]
        token = f"?token={self.token}" if self.token else ""
        shown = (f"[{host}]" if ":" in host else host for host in hosts)
        return tuple(f"http://{host}:{self.port}/{token}" for host in shown)

    def close(self) -> None:
        """Serve no longer."""
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


def _outward() -> list[str]:
    """The IP address from which this computer would send to others; none without a network."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        try:
            asking.connect(("192.0.2.1", 9))  # an address for examples; nothing is sent
        except OSError:
            return []
        return [str(asking.getsockname()[0])]


def _made(simulator: Simulator) -> tuple[Any, Any]:
    # NiceGUI would make a folder of its own wherever the program was started.
    os.environ.setdefault("NICEGUI_STORAGE_PATH", str(cache_folder() / "viewer"))
    try:
        import uvicorn

        from us_sim.viewer.page import make_application
    except ImportError as error:
        raise UsSimError(
            f"the viewer needs {error.name}: install it with `pip install 'us_sim[viewer]'`"
        ) from error
    return uvicorn, make_application(simulator)


def _checked(token: str) -> str:
    """That token, or none.

    Raises:
        UsSimError: it will not do.
    """
    if token and not re.fullmatch(r"[A-Za-z0-9_.~-]{16,}", token):
        raise UsSimError(
            "the viewer's token must have 16 letters, digits, or characters of _.~- at least: set "
            "US_SIM_VIEWER_TOKEN to another, or not at all"
        )
    return token
