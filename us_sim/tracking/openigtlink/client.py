"""Poses from an OpenIGTLink server (Plus, 3D Slicer, a tracker's own), whenever it is there."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import PoseError, TrackingError
from us_sim.geometry.pose import Pose
from us_sim.tracking.measurement import Measurement
from us_sim.tracking.openigtlink.message import (
    HEADER,
    NAME_LENGTH,
    POSE_KINDS,
    Header,
    header_of,
    poses_in,
    start_tracking_message,
)
from us_sim.tracking.openigtlink.settings import OpenIGTLinkSettings

LPS_FROM_RAS = Pose(orientation=np.array([0.0, 0.0, 1.0, 0.0]))
"""Half a turn about z: x and y change sign."""

_RETRY_S = 1.0
_CONNECT_S = 2.0
_LONGEST_POSES = 1 << 20  # bytes: a message with more than that is no list of poses
_SKIPPED_AT_ONCE = 1 << 16
_SAY_EVERY_S = 1.0
_MOST_NAMES = 100  # of a server's bodies, to be told


class OpenIGTLinkClient:
    """A thread that stays connected and hands on each pose of one body.

    Args:
        settings: the server's address, and the frame of its poses.
        body: name of the device, or of the body in a TDATA; None for the only one.
        take: called in the client's thread with each measurement, whose stamp is the message's
            (0 where it has none).
        problem: called there with the kind and a sentence when something is not as it should be.
        connected: called there when the connection stands.
    """

    def __init__(
        self,
        settings: OpenIGTLinkSettings,
        body: str | None,
        take: Callable[[Measurement], None],
        problem: Callable[[str, str], None],
        connected: Callable[[], None] = lambda: None,
    ) -> None:
        self._settings = settings
        self._body = body
        self._take, self._problem, self._say_connected = take, problem, connected
        #: The server's address, for a person.
        self.place = f"{settings.host}:{settings.port}"
        self._names: dict[str, None] = {}
        self._heard = time.monotonic()
        self._stamp = 0  # ns, of the newest pose handed on
        self._closing = threading.Event()
        self._socket: socket.socket | None = None
        self._thread = threading.Thread(target=self._run, name="openigtlink", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Disconnect, and wait for the thread to end."""
        self._closing.set()
        connection = self._socket
        if connection is not None:
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
        self._thread.join(_CONNECT_S + _RETRY_S)

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                self._converse()
            except Exception as error:  # whatever it sends, it is tried again
                if not self._closing.is_set():
                    why = getattr(error, "strerror", None) or error
                    self._problem(
                        "connection",
                        f"no poses from an OpenIGTLink server at {self.place} ({why}): start it, "
                        f"or set tracker.openigtlink in the scene; it is tried again",
                    )
            self._closing.wait(_RETRY_S)

    def _converse(self) -> None:
        """Connect and read until the server or `close` ends it.

        Raises:
            OSError, TrackingError: the connection fails, is lost, or is of another protocol.
        """
        settings = self._settings
        with socket.create_connection((settings.host, settings.port), _CONNECT_S) as connection:
            self._socket = connection
            connection.settimeout(None)
            _keep_alive(connection)
            if settings.tracking_data:
                connection.sendall(start_tracking_message(settings.interval))
            self._names.clear()
            self._heard = time.monotonic()
            self._say_connected()
            while not self._closing.is_set():
                header = header_of(_read(connection, HEADER.size))
                if header.kind not in POSE_KINDS:
                    _skip(connection, header.size)
                    continue
                if header.size > _LONGEST_POSES:
                    raise TrackingError(f"a {header.kind} of {header.size} bytes cannot be")
                self._handle(header, _read(connection, header.size))

    def _handle(self, header: Header, body: bytes) -> None:
        try:
            poses = poses_in(header, body)
        except TrackingError as error:
            if self._is_wanted(header.device) or header.kind.endswith("TDATA"):
                self._problem("message", f"{self.place}: {error}; it is not used")
            return
        for name, matrix in poses:
            if not self._is_wanted(name):
                continue
            self._heard = time.monotonic()
            try:
                pose = self._in_metres(matrix)
            except PoseError as error:
                self._problem("pose", f"{self.place}: {name}: {error}; it is not used")
                continue
            if header.stamp and header.stamp == self._stamp:
                # Some servers repeat the last pose of a body that they do not see.
                self._problem("repeated", f"{self.place}: {name} is only a repeat; it is not used")
                continue
            self._stamp = header.stamp
            self._take(Measurement(header.stamp, pose))

    def _is_wanted(self, name: str) -> bool:
        """Whether a name is the body's; reports now and then when only others come."""
        if len(self._names) < _MOST_NAMES:
            self._names[name] = None
        if self._body is None:
            if len(self._names) == 1:
                return True
            wanted = "the body"
        elif name == self._body or name == self._body[:NAME_LENGTH]:
            return True
        else:
            wanted = self._body
        if time.monotonic() - self._heard > _SAY_EVERY_S:
            self._heard = time.monotonic()
            self._problem(
                "body",
                f"{self.place} sends no poses of {wanted}: set tracker.body in the scene to one "
                f"of {', '.join(self._names)}",
            )
        return False

    def _in_metres(self, matrix: NDArray[np.float64]) -> Pose:
        pose = Pose.from_matrix(matrix)
        return LPS_FROM_RAS @ pose if self._settings.world == "ras" else pose


def _keep_alive(connection: socket.socket) -> None:
    """Notice within seconds that the other computer is gone, though nothing is sent to it."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    for option, value in (("TCP_KEEPIDLE", 2), ("TCP_KEEPINTVL", 1), ("TCP_KEEPCNT", 3)):
        if hasattr(socket, option):
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)


def _read(connection: socket.socket, size: int) -> bytes:
    """Read that many bytes.

    Raises:
        TrackingError: the server has closed the connection.
    """
    data = bytearray(size)
    view = memoryview(data)
    while view:
        count = connection.recv_into(view)
        if not count:
            raise TrackingError("it has closed the connection")
        view = view[count:]
    return bytes(data)


def _skip(connection: socket.socket, size: int) -> None:
    while size:
        size -= len(_read(connection, min(size, _SKIPPED_AT_ONCE)))
