"""Pixels of the images that camera drivers send, in any of their encodings."""

from __future__ import annotations

import contextlib
import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.errors import TrackingError, VolumeError
from us_sim.recording.decoding import rows_from

# Bytes a pixel, and OpenCV's name of the colours where it is no grey. A Bayer pattern is named by
# ROS after its first row's first two pixels, and by OpenCV after its second row's second two.
_ENCODINGS: dict[str, tuple[int, str]] = {
    "mono8": (1, ""),
    "8UC1": (1, ""),
    "mono16": (2, ""),
    "16UC1": (2, ""),
    "bgr8": (3, "BGR2{}"),
    "8UC3": (3, "BGR2{}"),
    "rgb8": (3, "RGB2{}"),
    "bgra8": (4, "BGRA2{}"),
    "8UC4": (4, "BGRA2{}"),
    "rgba8": (4, "RGBA2{}"),
    "yuv422_yuy2": (2, "YUV2{}_YUY2"),
    "yuyv": (2, "YUV2{}_YUY2"),
    "yuv422": (2, "YUV2{}_UYVY"),
    "uyvy": (2, "YUV2{}_UYVY"),
    "bayer_rggb8": (1, "BayerBG2{}"),
    "bayer_bggr8": (1, "BayerRG2{}"),
    "bayer_gbrg8": (1, "BayerGR2{}"),
    "bayer_grbg8": (1, "BayerGB2{}"),
}

_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
_MOST_SEGMENTS = 1000  # of a JPEG before its picture
_MOST_PIXELS = 1 << 26  # of a compressed image: as many as 8192 × 8192


def decode_image(message: Any, colours: str) -> NDArray[np.uint8]:
    """Return the pixels of a sensor_msgs/Image.

    Args:
        message: the image.
        colours: ``GRAY`` for (rows, columns), ``RGB`` for (rows, columns, 3).

    Raises:
        TrackingError: the encoding is not known, or there are fewer bytes than the size says.
    """
    if message.encoding not in _ENCODINGS:
        raise TrackingError(
            f"the image's encoding is '{message.encoding}'; known are {', '.join(_ENCODINGS)}"
        )
    size, conversion = _ENCODINGS[message.encoding]
    code = getattr(cv2, f"COLOR_{conversion.format(colours)}", None)  # none of RGB to itself
    try:
        rows = rows_from(message, size)
    except VolumeError as error:
        raise TrackingError(str(error)) from None
    if message.encoding in ("mono16", "16UC1"):
        high = 0 if message.is_bigendian else 1  # the more significant byte is enough
        return np.ascontiguousarray(rows[:, high::2])
    if not conversion:
        return np.ascontiguousarray(rows)
    pixels = rows if size == 1 else rows.reshape(message.height, message.width, size)
    if code is None:
        return np.ascontiguousarray(pixels)
    try:
        converted = cv2.cvtColor(np.ascontiguousarray(pixels), code)
    except cv2.error as error:  # an odd width of pairs, say, or a Bayer pattern of one pixel
        raise TrackingError(
            f"an image of {message.width} × {message.height} pixels cannot be {message.encoding}"
        ) from error
    return np.asarray(converted, dtype=np.uint8)


def decompress_image(message: Any, colours: str) -> NDArray[np.uint8]:
    """Return the pixels of a sensor_msgs/CompressedImage, a JPEG or PNG, as `decode_image` does.

    Raises:
        TrackingError: it cannot be decoded, or is larger than any camera's.
    """
    data = np.frombuffer(message.data, dtype=np.uint8)
    columns, rows = _stated_size(data.tobytes())
    pixels = None
    if columns * rows <= _MOST_PIXELS:
        with contextlib.suppress(cv2.error):
            flag = cv2.IMREAD_GRAYSCALE if colours == "GRAY" else cv2.IMREAD_COLOR
            pixels = cv2.imdecode(data, flag) if columns and rows else None
    if pixels is None:
        raise TrackingError(
            f"the compressed image ('{message.format}', {data.size} bytes for {columns} × {rows} "
            f"pixels) cannot be decoded: it must be a JPEG or PNG of {_MOST_PIXELS} pixels at most"
        )
    found = np.asarray(pixels, dtype=np.uint8)
    return found if found.ndim == 2 else np.ascontiguousarray(found[..., ::-1])  # of BGR


def _stated_size(data: bytes) -> tuple[int, int]:
    """Columns and rows by a PNG's or JPEG's header; 0 and 0 where it is neither.

    A few bytes may say that they are gigabytes, and are taken at their word when decoded.
    """
    if data.startswith(_PNG) and len(data) >= 24:
        columns, rows = struct.unpack_from(">II", data, 16)
        return columns, rows
    place = 2
    for _ in range(_MOST_SEGMENTS):
        if not data.startswith(_JPEG) or place + 9 > len(data) or data[place] != 0xFF:
            break
        marker, length = data[place + 1], struct.unpack_from(">H", data, place + 2)[0]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # a start of frame
            rows, columns = struct.unpack_from(">HH", data, place + 5)
            return columns, rows
        place += 1 if marker == 0xFF else 2 + length
    return 0, 0
