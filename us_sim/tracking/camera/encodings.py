"""Pixels of the images that camera drivers send, in any of their encodings."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.errors import TrackingError, VolumeError
from us_sim.recording.decoding import rows_from

_GREY, _BGR, _YUYV = "", "BGR2{}", "YUV2{}_YUY2"
# A Bayer pattern is named by ROS after its first row's first two pixels, and by OpenCV after its
# second row's second two.
_BAYER = {"rggb": "BG", "bggr": "RG", "gbrg": "GR", "grbg": "GB"}
# Bytes a pixel, and OpenCV's name of the colours where it is no grey.
_ENCODINGS: dict[str, tuple[int, str]] = {
    **dict.fromkeys(("mono8", "8UC1"), (1, _GREY)),
    **dict.fromkeys(("mono16", "16UC1"), (2, _GREY)),
    **dict.fromkeys(("bgr8", "8UC3"), (3, _BGR)),
    "rgb8": (3, "RGB2{}"),
    **dict.fromkeys(("bgra8", "8UC4"), (4, "BGRA2{}")),
    "rgba8": (4, "RGBA2{}"),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), (2, _YUYV)),
    **dict.fromkeys(("yuv422", "uyvy"), (2, "YUV2{}_UYVY")),
    "nv12": (1, "YUV2{}_NV12"),
    "nv21": (1, "YUV2{}_NV21"),
    **{f"bayer_{name}8": (1, f"Bayer{code}2{{}}") for name, code in _BAYER.items()},
    **{f"bayer_{name}16": (2, f"Bayer{code}2{{}}") for name, code in _BAYER.items()},
}
_DEPTHS = (8, 10, 12, 14, 16)  # bits of a sensor


def decode_image(message: Any, colours: str) -> NDArray[np.uint8]:
    """Return the pixels of a sensor_msgs/Image.

    Of 16 bits those are taken that its brightest pixel needs: sensors fill the lower 10, 12 or 14.

    Args:
        message: the image.
        colours: ``GRAY`` for (rows, columns), ``RGB`` for (rows, columns, 3).

    Raises:
        TrackingError: the encoding is not known or not that of the bytes, or there are fewer bytes
            than the size says.
    """
    encoding = message.encoding
    if encoding not in _ENCODINGS:
        raise TrackingError(
            f"the image's encoding is '{encoding}'; known are {', '.join(_ENCODINGS)}"
        )
    size, conversion = _ENCODINGS[encoding]
    code = getattr(cv2, f"COLOR_{conversion.format(colours)}", None)  # none of RGB to itself
    try:
        pixels = np.ascontiguousarray(_read_rows(message, size))
    except VolumeError as error:
        raise TrackingError(str(error)) from None
    if encoding.endswith(("16", "16UC1")):
        pixels = _to_8_bits(pixels.view(">u2" if message.is_bigendian else "<u2"))
    elif size > 1:
        pixels = pixels.reshape(message.height, message.width, size)
    if code is None:
        return pixels
    try:
        return np.asarray(cv2.cvtColor(pixels, code), dtype=np.uint8)
    except cv2.error as error:  # an odd width of pairs, say, or a Bayer pattern of one pixel
        raise TrackingError(
            f"an image of {message.width} × {message.height} pixels cannot be {encoding}"
        ) from error


def _read_rows(message: Any, size: int) -> NDArray[np.uint8]:
    """Return the bytes row by row, those of colours after those of grey."""
    rows = rows_from(message, size)
    if not message.encoding.startswith("nv"):
        return rows
    step = int(message.step) or int(message.width)
    count = int(message.height) * 3 // 2
    if len(message.data) < count * step:
        raise VolumeError(
            f"the image holds {len(message.data)} bytes, but {message.encoding} of its size has "
            f"{count * step}"
        )
    flat = np.frombuffer(message.data, dtype=np.uint8, count=count * step)
    return flat.reshape(count, step)[:, : message.width]


def _to_8_bits(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    """Return the most significant bits of the least depth that holds all pixels."""
    brightest = int(pixels.max())
    depth = next(bits for bits in _DEPTHS if brightest < 1 << bits)
    return (pixels >> (depth - 8)).astype(np.uint8)


def decompress_image(message: Any, colours: str) -> NDArray[np.uint8]:
    """Return the pixels of a sensor_msgs/CompressedImage, a JPEG or PNG, as `decode_image` does.

    Raises:
        TrackingError: it cannot be decoded.
    """
    data = np.frombuffer(message.data, dtype=np.uint8)
    flags = cv2.IMREAD_GRAYSCALE if colours == "GRAY" else cv2.IMREAD_COLOR
    flags |= cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        pixels: Any = cv2.imdecode(data, flags) if data.size else None
    except cv2.error:  # larger than OpenCV takes
        pixels = None
    if pixels is None or pixels.dtype not in (np.uint8, np.uint16):
        raise TrackingError(
            f"the compressed image ('{message.format}', {data.size} bytes) cannot be decoded: it "
            f"must be a JPEG or PNG"
        )
    found = pixels if pixels.dtype == np.uint8 else _to_8_bits(pixels)
    return found if found.ndim == 2 else np.ascontiguousarray(found[..., ::-1])  # of BGR
