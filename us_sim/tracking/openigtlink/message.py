"""OpenIGTLink messages as bytes: poses in, images and transforms out (openigtlink.org, v1 to v3).

Everything is big-endian and in millimetres; a checksum is written but, over TCP, not asked for.

>>> import numpy as np
>>> from us_sim.tracking.openigtlink.message import HEADER, header_of, poses_in, transform_message
>>> matrix = np.eye(4)
>>> matrix[:3, 3] = [0.01, 0.02, 0.03]
>>> message = transform_message("ProbeToTracker", 1_500_000_000, matrix)
>>> header = header_of(message[: HEADER.size])
>>> header.kind, header.device, header.stamp, header.size
('TRANSFORM', 'ProbeToTracker', 1500000000, 48)
>>> [(name, matrix)] = poses_in(header, message[HEADER.size :])
>>> name, matrix[:3, 3].round(6)
('ProbeToTracker', array([0.01, 0.02, 0.03]))
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import PoseError, TrackingError
from us_sim.geometry.pose import Pose
from us_sim.kernels import njit

HEADER = struct.Struct(">H12s20sIIQQ")
"""Version, type, device, seconds, fraction of a second, size of the body, its checksum."""

NAME_LENGTH = 20
"""Bytes of a device's name, which is cut to that."""

POSE_KINDS = ("TRANSFORM", "TDATA", "QTDATA", "POSITION")
"""Types of message in which there are poses."""

_METRES = 1e-3
_VERSIONS = (1, 2, 3)
_EXTENSION = struct.Struct(">HHII")  # its size, metadata's header and body, message number
_METADATA = struct.Struct(">HHI")  # key's length, value's encoding and length
_MATRIX = np.dtype((">f4", 12))  # column after column of the upper three rows
_ELEMENTS = {
    "TDATA": np.dtype([("name", "S20"), ("type", "u1"), ("reserved", "u1"), ("matrix", _MATRIX)]),
    "QTDATA": np.dtype([("name", "S20"), ("type", "u1"), ("reserved", "u1"), ("pose", (">f4", 7))]),
}
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


def header_of(data: bytes) -> Header:
    """The header in its 58 bytes.

    Raises:
        TrackingError: they are none.
    """
    version, kind, device, seconds, fraction, size, _ = HEADER.unpack(data)
    try:
        name = kind.rstrip(b"\0 ").decode("ascii")
    except UnicodeDecodeError:
        name = ""
    if version not in _VERSIONS or not name.replace("_", "").isalnum():
        raise TrackingError("what came is no OpenIGTLink message")
    stamp = seconds * 10**9 + (fraction * 10**9 + 2**31 >> 32)
    return Header(version, name, _text(device), stamp, size)


def poses_in(header: Header, body: bytes) -> list[tuple[str, NDArray[np.float64]]]:
    """Names and matrices (4, 4) m of the bodies in a message of one of `POSE_KINDS`.

    The matrices are as they were sent: maybe not rigid, or not finite.

    Raises:
        TrackingError: the body is cut or of another layout, or the sender says that the pose is
            not valid.
    """
    content = body
    if header.version > 1:
        content, metadata = _without_extension(header, body)
        status = metadata.get("TransformStatus", "OK")  # of Plus
        if status.upper() != "OK":
            raise TrackingError(f"the server says that {header.device} is {status}")
    if header.kind in _ELEMENTS:
        element = _ELEMENTS[header.kind]
        if len(content) % element.itemsize:
            raise _wrong_size(header, len(content))
        rows = np.frombuffer(content, dtype=element)
        field = "matrix" if header.kind == "TDATA" else "pose"
        make = _of_columns if header.kind == "TDATA" else _of_quaternion
        return [(_text(row["name"]), make(row[field].astype(np.float64))) for row in rows]
    wanted = 12 if header.kind == "TRANSFORM" else 7
    if len(content) != 4 * wanted:
        raise _wrong_size(header, len(content))
    numbers = np.frombuffer(content, dtype=">f4").astype(np.float64)
    make = _of_columns if header.kind == "TRANSFORM" else _of_quaternion
    return [(header.device, make(numbers))]


def transform_message(
    device: str, stamp: int, matrix: NDArray[np.float64], *, per_pixel: bool = False
) -> bytes:
    """A TRANSFORM message of version 1, at ``stamp`` ns, of an affine matrix (4, 4).

    It leads from metres to metres or, ``per_pixel``, from pixels to metres.
    """
    numbers = matrix[:3].T.copy()
    numbers[0 if per_pixel else 3 :] /= _METRES
    return _packed("TRANSFORM", device, stamp, numbers.astype(">f4").tobytes())


def image_message(
    device: str,
    stamp: int,
    pixels: NDArray[np.uint8],
    matrix: NDArray[np.float64],
    world: str,
) -> bytes:
    """An IMAGE message of version 1, at ``stamp`` ns, of grey pixels (rows, columns).

    Args:
        device: name of the image.
        stamp: ns.
        pixels: (rows, columns).
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
    return _packed("IMAGE", device, stamp, head + np.ascontiguousarray(pixels).tobytes())


def start_tracking_message(interval: float) -> bytes:
    """Ask for TDATA at most every ``interval`` s."""
    body = struct.pack(">I32s", max(round(interval * 1e3), 1), b"")
    return _packed("STT_TDATA", "", 0, body)


def _packed(kind: str, device: str, stamp: int, body: bytes) -> bytes:
    seconds, rest = divmod(stamp, 10**9)
    fraction = min((rest * 2**32 + 5 * 10**8) // 10**9, 2**32 - 1)
    name = device.encode("ascii", "replace")[:NAME_LENGTH]
    checksum = int(_crc64(np.frombuffer(body, dtype=np.uint8), _CRC_TABLE))
    return HEADER.pack(1, kind.encode(), name, seconds, fraction, len(body), checksum) + body


def _text(name: bytes) -> str:
    return bytes(name).split(b"\0")[0].decode("ascii", "replace").strip()


def _wrong_size(header: Header, size: int) -> TrackingError:
    return TrackingError(f"a {header.kind} of {header.device!r} has {size} bytes, which cannot be")


def _without_extension(header: Header, body: bytes) -> tuple[bytes, dict[str, str]]:
    """The content and the metadata of a message of version 2 or 3."""
    try:
        begin, heads, values, _ = _EXTENSION.unpack_from(body)
        end = len(body) - heads - values
        if not _EXTENSION.size <= begin <= end:
            raise _wrong_size(header, len(body))
        metadata: dict[str, str] = {}
        if heads:
            (count,) = struct.unpack_from(">H", body, end)
            at = end + heads
            for number in range(count):
                key, _, value = _METADATA.unpack_from(body, end + 2 + number * _METADATA.size)
                text = body[at : at + key + value].decode("utf-8", "replace")
                metadata[text[:key]] = text[key:]
                at += key + value
    except struct.error as error:
        raise _wrong_size(header, len(body)) from error
    return body[begin:end], metadata


def _of_columns(numbers: NDArray[np.float64]) -> NDArray[np.float64]:
    matrix = np.eye(4)
    matrix[:3] = numbers.reshape(4, 3).T
    matrix[:3, 3] *= _METRES
    return matrix


def _of_quaternion(numbers: NDArray[np.float64]) -> NDArray[np.float64]:
    """x, y, z mm and the quaternion x, y, z, w; nan where that is none."""
    try:
        return Pose(_METRES * numbers[:3], numbers[3:]).matrix
    except PoseError:
        return np.full((4, 4), np.nan)


def _crc_table() -> NDArray[np.uint64]:
    """Checksums of single bytes: CRC-64 of ECMA-182, most significant bit first."""
    table = np.empty(256, dtype=np.uint64)
    for byte in range(256):
        crc = byte << 56
        for _ in range(8):
            crc = (crc << 1 ^ (0x42F0E1EBA9EA3693 if crc >> 63 else 0)) & (2**64 - 1)
        table[byte] = crc
    return table


_CRC_TABLE = _crc_table()


@njit(cache=True, nogil=True, error_model="numpy")
def _crc64(data, table):
    crc = np.uint64(0)
    for byte in data:
        crc = table[(crc >> np.uint64(56)) ^ np.uint64(byte)] ^ (crc << np.uint64(8))
    return crc
