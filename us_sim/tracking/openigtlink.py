"""OpenIGTLink: messages as bytes, a client of a tracker's server, and a server of images and poses.

Messages are those of openigtlink.org, versions 1 to 3: big-endian and in millimetres. A message
whose checksum is wrong is refused; senders that make none write 0. The package pyigtl knows neither
TDATA nor metadata, checks no checksum of what it receives, and takes a process' signals.

>>> from us_sim.tracking.openigtlink import HEADER, parse_header, parse_poses, pack_transform
>>> matrix = np.eye(4)
>>> matrix[:3, 3] = [0.01, 0.02, 0.03]
>>> message = pack_transform("ProbeToTracker", 1_500_000_000, matrix)
>>> header = parse_header(message[: HEADER.size])
>>> [(name, matrix)] = parse_poses(header, message[HEADER.size :])
>>> name, matrix[:3, 3].round(6)
('ProbeToTracker', array([0.01, 0.02, 0.03]))
"""

from __future__ import annotations

import contextlib
import select
import socket
import socketserver
import struct
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import PoseError, TrackingError
from us_sim.geometry.pose import Pose
from us_sim.kernels import njit
from us_sim.tracking.measurement import Measurement
from us_sim.tracking.settings import OpenIGTLinkSettings

HEADER = struct.Struct(">H12s20sIIQQ")
"""Version, type, device, seconds, fraction of a second, size of the body, its checksum."""

NAME_LENGTH = 20  # bytes of a device's name, which is cut to that

POSE_KINDS = ("TRANSFORM", "TDATA")
"""Types of message in which there are poses."""

_METRES = 1e-3
_VERSIONS = (1, 2, 3)
_EXTENSION = struct.Struct(">HHII")  # its size, metadata's header and body, message number
_METADATA = struct.Struct(">HHI")  # key's length, value's encoding and length
_ELEMENT = np.dtype([("name", "S20"), ("type", "u1"), ("reserved", "u1"), ("numbers", ">f4", 12)])
"""A body of a TDATA, with a matrix as in a TRANSFORM."""
_IMAGE = struct.Struct(">HBBBB3H12f6H")
_UINT8, _BIG_ENDIAN = 3, 1
_WORLDS = {"ras": 1, "lps": 2}


@dataclass(frozen=True)
class Header:
    """The header of a message."""

    version: int
    kind: str
    device: str
    stamp: int  # ns, 0 where the sender does not say
    size: int  # bytes of the body
    checksum: int = 0  # of the body; 0 where the sender makes none


def parse_header(data: bytes) -> Header:
    """Parse a header from its 58 bytes.

    Raises:
        TrackingError: they are no header.
    """
    version, kind, device, seconds, fraction, size, checksum = HEADER.unpack(data)
    try:
        name = kind.rstrip(b"\0 ").decode("ascii")
    except UnicodeDecodeError:
        name = ""
    if version not in _VERSIONS or not name.replace("_", "").isalnum():
        raise TrackingError("what came is no OpenIGTLink message")
    stamp = seconds * 10**9 + (fraction * 10**9 + 2**31 >> 32)
    return Header(version, name, _text(device), stamp, size, checksum)


def parse_poses(header: Header, body: bytes) -> list[tuple[str, NDArray[np.float64]]]:
    """Parse names and matrices (4, 4) m of the bodies in a message of one of `POSE_KINDS`.

    The matrices are as they were sent: maybe not rigid, or not finite.

    Raises:
        TrackingError: the body is damaged, cut or of another layout, or the sender says that the
            pose is not valid.
    """
    if header.checksum not in (0, _checksum(body)):
        raise TrackingError(f"the checksum of a {header.kind} of {header.device!r} is wrong")
    content = body
    if header.version > 1:
        content, metadata = _strip_extension(header, body)
        status = metadata.get("TransformStatus", "OK")  # of Plus
        if status.upper() != "OK":
            raise TrackingError(f"the server says that {header.device} is {status}")
    if header.kind == "TDATA":
        if len(content) % _ELEMENT.itemsize:
            raise _wrong_size(header, len(content))
        rows = np.frombuffer(content, dtype=_ELEMENT)
        return [(_text(row["name"]), _unpack_columns(row["numbers"])) for row in rows]
    if len(content) != 48:
        raise _wrong_size(header, len(content))
    return [(header.device, _unpack_columns(np.frombuffer(content, dtype=">f4")))]


def pack_transform(
    device: str, stamp: int, matrix: NDArray[np.float64], *, per_pixel: bool = False
) -> bytes:
    """Pack a TRANSFORM message of version 1, at ``stamp`` ns, of an affine matrix (4, 4).

    The matrix leads from metres to metres or, ``per_pixel``, from pixels to metres.
    """
    numbers = matrix[:3].T.copy()
    numbers[0 if per_pixel else 3 :] /= _METRES
    return _pack("TRANSFORM", device, stamp, numbers.astype(">f4").tobytes())


def pack_image(
    device: str, stamp: int, pixels: NDArray[np.uint8], matrix: NDArray[np.float64], world: str
) -> bytes:
    """Pack an IMAGE message of version 1.

    Args:
        device: name of the image.
        stamp: ns.
        pixels: (rows, columns), grey.
        matrix: (4, 4), from (column, row, slice, 1) of pixel centres to m of the world.
        world: "ras" or "lps".

    Raises:
        TrackingError: OpenIGTLink has no images of that size.
    """
    rows, columns = pixels.shape
    if max(rows, columns) > 65_535:
        raise TrackingError(f"an image of {columns} × {rows} pixels is too large for OpenIGTLink")
    middle = matrix.copy()
    middle[:3, 3] = (matrix @ [(columns - 1) / 2, (rows - 1) / 2, 0.0, 1.0])[:3]
    # A map from pixels to metres becomes one to millimetres in all of its columns.
    numbers = middle[:3].T.ravel() / _METRES
    size = (columns, rows, 1)
    head = _IMAGE.pack(1, 1, _UINT8, _BIG_ENDIAN, _WORLDS[world], *size, *numbers, 0, 0, 0, *size)
    return _pack("IMAGE", device, stamp, head + np.ascontiguousarray(pixels).tobytes())


def _pack(kind: str, device: str, stamp: int, body: bytes) -> bytes:
    seconds, rest = divmod(stamp, 10**9)
    fraction = min((rest * 2**32 + 5 * 10**8) // 10**9, 2**32 - 1)
    name = device.encode("ascii", "replace")[:NAME_LENGTH]
    numbers = seconds, fraction, len(body), _checksum(body)
    return HEADER.pack(1, kind.encode(), name, *numbers) + body


def _text(name: bytes) -> str:
    return bytes(name).split(b"\0")[0].decode("ascii", "replace").strip()


def _wrong_size(header: Header, size: int) -> TrackingError:
    return TrackingError(f"a {header.kind} of {header.device!r} has {size} bytes, which cannot be")


def _strip_extension(header: Header, body: bytes) -> tuple[bytes, dict[str, str]]:
    """Return the content and the metadata of a message of version 2 or 3."""
    try:
        begin, heads, values, _ = _EXTENSION.unpack_from(body)
        end = len(body) - heads - values
        if not _EXTENSION.size <= begin <= end:
            raise _wrong_size(header, len(body))
        count = struct.unpack_from(">H", body, end)[0] if heads else 0
        sizes = [_METADATA.unpack_from(body, end + 2 + 8 * number) for number in range(count)]
    except struct.error as error:
        raise _wrong_size(header, len(body)) from error
    metadata: dict[str, str] = {}
    at = end + heads
    for key, _, value in sizes:
        text = body[at : at + key + value].decode("utf-8", "replace")
        metadata[text[:key]] = text[key:]
        at += key + value
    return body[begin:end], metadata


def _unpack_columns(numbers: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrix of its upper three rows, column after column, mm."""
    matrix = np.eye(4)
    matrix[:3] = numbers.reshape(4, 3).T
    matrix[:3, 3] *= _METRES
    return matrix


def _checksum(body: bytes) -> int:
    return int(_crc64(np.frombuffer(body, dtype=np.uint8), _CRC_TABLE))


# Checksums of single bytes: CRC-64 of ECMA-182, most significant bit first.
_CRC_TABLE = np.arange(256, dtype=np.uint64) << np.uint64(56)
for _ in range(8):
    _divisor = np.where(_CRC_TABLE >> np.uint64(63), np.uint64(0x42F0E1EBA9EA3693), np.uint64(0))
    _CRC_TABLE = _CRC_TABLE << np.uint64(1) ^ _divisor


@njit(cache=True, nogil=True, error_model="numpy")
def _crc64(data, table):
    crc = np.uint64(0)
    for byte in data:
        crc = table[(crc >> np.uint64(56)) ^ np.uint64(byte)] ^ (crc << np.uint64(8))
    return crc


LPS_FROM_RAS = Pose(orientation=np.array([0.0, 0.0, 1.0, 0.0]))
"""Half a turn about z: x and y change sign."""

_RETRY_S = 1.0
_CONNECT_S = 2.0
_SILENT_S = 10.0  # after which a server is taken for gone, as where its computer is off
_LONGEST = 1 << 30  # bytes of a message: what claims more is another protocol
_SAY_EVERY_S = 1.0
_ASKED = struct.pack(">I32s", 10, b"")  # TDATA, at most every 10 ms


class OpenIGTLinkClient:
    """A thread that stays connected and hands on each pose of one body.

    Args:
        settings: the server's address, and the frame of its poses.
        body: name of the device, or of the body in a TDATA; None for the only one.
        take: called in the client's thread with each measurement, whose stamp is the message's
            (0 where it has none).
        problem: called there with the kind and a sentence when something is not as it should be.
    """

    def __init__(
        self,
        settings: OpenIGTLinkSettings,
        body: str | None,
        take: Callable[[Measurement], None],
        problem: Callable[[str, str], None],
    ) -> None:
        self._settings = settings
        self._body = body
        self._take, self._problem = take, problem
        #: The server's address, for a person.
        self.place = f"{settings.host}:{settings.port}"
        self._names: dict[str, None] = {}
        self._heard = time.monotonic()
        self._newest: tuple[int, bytes] = (0, b"")  # stamp, ns, and matrix of the newest pose
        self._closing = threading.Event()
        self._socket: socket.socket | None = None
        self._thread = threading.Thread(target=self._run, name="openigtlink", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Disconnect, and wait for the thread to end."""
        self._closing.set()
        connection = self._socket
        if connection is not None:
            _shut(connection)
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
            OSError: the connection fails or is lost.
            TrackingError: it is closed, or of another protocol.
        """
        settings = self._settings
        with socket.create_connection((settings.host, settings.port), _CONNECT_S) as connection:
            self._socket = connection
            connection.settimeout(_SILENT_S)
            if settings.tracking_data:
                connection.sendall(_pack("STT_TDATA", "", 0, _ASKED))
            self._names.clear()
            self._heard = time.monotonic()
            stream = connection.makefile("rb")
            while not self._closing.is_set():
                header = parse_header(_read(stream, HEADER.size))
                if header.size > _LONGEST:
                    raise TrackingError(f"a {header.kind} of {header.size} bytes cannot be")
                body = _read(stream, header.size)
                if header.kind in POSE_KINDS:
                    self._handle(header, body)

    def _handle(self, header: Header, body: bytes) -> None:
        try:
            poses = parse_poses(header, body)
        except TrackingError as error:
            if self._is_wanted(header.device) or header.kind.endswith("TDATA"):
                self._problem("message", f"{self.place}: {error}; it is not used")
            return
        for name, matrix in poses:
            if not self._is_wanted(name):
                continue
            self._heard = time.monotonic()
            try:
                pose = Pose.from_matrix(matrix)
            except PoseError as error:
                self._problem("pose", f"{self.place}: {name}: {error}; it is not used")
                continue
            before, self._newest = self._newest, (header.stamp, matrix.tobytes())
            if header.stamp and header.stamp == before[0]:
                if self._newest == before:
                    # Some servers repeat the last pose of a body that they do not see.
                    said = f"{name} is only a repeat; it is not used"
                    self._problem("repeated", f"{self.place}: {said}")
                    continue
                if self._settings.clock == "server":
                    self._problem(
                        "clock",
                        f"{self.place}: {name} moves while its stamp stands still; it is not used: "
                        f"set tracker.openigtlink.clock in the scene to arrival",
                    )
                    continue
            if self._settings.world == "ras":
                pose = LPS_FROM_RAS @ pose
            self._take(Measurement(header.stamp, pose))

    def _is_wanted(self, name: str) -> bool:
        """Return whether a name is the body's; report now and then when only others come."""
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


def _read(stream: BinaryIO, size: int) -> bytes:
    """Read that many bytes; raise TrackingError where the server has closed the connection."""
    data = stream.read(size)
    if len(data) < size:
        raise TrackingError("it has closed the connection")
    return data


class _Listener(socketserver.ThreadingTCPServer):
    allow_reuse_address = daemon_threads = True


_READ_AT_ONCE = 1 << 16
_LOOK_S = 0.2  # between two looks for clients that came, sent something, or are gone


class OpenIGTLinkServer:
    """Threads that send the newest message of each name to every client.

    A client that is too slow for all messages gets the newest ones; what a client sends is read
    and dropped.

    Args:
        host: name or address to listen at; an empty text for every one this computer has.
        port: TCP port; 0 for any that is free, see `port`.

    Raises:
        TrackingError: it cannot listen there.
    """

    def __init__(self, host: str, port: int) -> None:
        try:
            self._listener = _Listener((host, port), self._serve)  # type: ignore[arg-type]
        except OSError as error:
            raise TrackingError(
                f"cannot serve OpenIGTLink at {host or 'every address'}, port {port} "
                f"({error.strerror or error}): end what uses the port, or choose another"
            ) from error
        self.port = int(self._listener.server_address[1])
        self._waiting: dict[socket.socket, dict[str, bytes]] = {}  # of each client, by name
        self._changed = threading.Condition()
        threading.Thread(target=self._listener.serve_forever, args=(_LOOK_S,), daemon=True).start()

    @property
    def client_count(self) -> int:
        """Number of clients connected."""
        return len(self._waiting)

    def send_message(self, name: str, message: bytes) -> None:
        """Send a message to all clients; one of the same name that has not left yet is dropped."""
        with self._changed:
            for waiting in self._waiting.values():
                waiting[name] = message
            self._changed.notify_all()

    def close(self) -> None:
        """Disconnect all, and wait until they are gone."""
        self._listener.shutdown()
        self._listener.server_close()
        with self._changed:
            for connection in self._waiting:
                _shut(connection)
            self._changed.wait_for(lambda: not self._waiting, _CONNECT_S)

    def _serve(self, connection: socket.socket, *_: object) -> None:
        """Send a client the messages that wait for it, until it is gone."""
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        waiting: dict[str, bytes] = {}
        with self._changed:
            self._waiting[connection] = waiting
        with contextlib.suppress(OSError):
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: waiting, _LOOK_S)
                    message = waiting.pop(next(iter(waiting))) if waiting else b""
                connection.sendall(message)
                is_readable = bool(select.select([connection], [], [], 0)[0])
                if is_readable and not connection.recv(_READ_AT_ONCE):
                    break
        with self._changed:
            del self._waiting[connection]
            self._changed.notify_all()


def _shut(connection: socket.socket) -> None:
    """Shut both directions down, which ends every wait for it."""
    with contextlib.suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)
