"""Grey and colour images, and where their pixels are."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from numpy.typing import NDArray
from sensor_msgs.msg import Image
from std_msgs.msg import Float64MultiArray, MultiArrayDimension

from us_sim.errors import ProbeError, VolumeError
from us_sim.nodes.conversions.packing import packed

_FIELD = re.compile(r"32FC([1-4])")
_LARGEST = 1e6
"""m, of a pixel, or to the first one."""


def image_message(pixels: NDArray[np.uint8], stamp: Time, frame: str) -> Image:
    """A ``mono8`` image of (rows, columns) pixels."""
    return _image(pixels, "mono8", 1, stamp, frame)


def colour_image_message(pixels: NDArray[np.uint8], stamp: Time, frame: str) -> Image:
    """An ``rgb8`` image of (rows, columns, 3) pixels: red, green, blue."""
    return _image(pixels, "rgb8", 3, stamp, frame)


def bgr_image_message(pixels: NDArray[np.uint8], stamp: Time, frame: str) -> Image:
    """A ``bgr8`` image of (rows, columns, 3) pixels, as OpenCV has them."""
    return _image(pixels, "bgr8", 3, stamp, frame)


def field_message(values: NDArray[np.float32], stamp: Time, frame: str) -> Image:
    """A ``32FC…`` image of (rows, columns) values, or of (rows, columns, K); NaN is none there."""
    count = 1 if values.ndim == 2 else values.shape[2]
    return _image(values, f"32FC{count}", 4 * count, stamp, frame)


def _image(pixels: NDArray[Any], encoding: str, size: int, stamp: Time, frame: str) -> Image:
    message = Image()
    message.header.stamp = stamp
    message.header.frame_id = frame
    message.height, message.width = pixels.shape[:2]
    message.encoding = encoding
    message.is_bigendian = 0
    message.step = size * message.width
    message.data = packed("B", pixels)
    return message


def pixels_from(message: Image) -> NDArray[np.uint8]:
    """The (rows, columns) pixels of a ``mono8`` image.

    Raises:
        VolumeError: another encoding, no pixels, or fewer bytes than the stated size.
    """
    if message.encoding not in ("mono8", "8UC1"):
        raise VolumeError(f"the image is {message.encoding}; it must be mono8")
    return _lines(message, 1)


def colour_pixels_from(message: Image) -> NDArray[np.uint8]:
    """The (rows, columns, 3) pixels of an ``rgb8`` image: red, green, blue.

    Raises:
        VolumeError: another encoding, no pixels, or fewer bytes than the stated size.
    """
    if message.encoding != "rgb8":
        raise VolumeError(f"the image is {message.encoding}; it must be rgb8")
    return _lines(message, 3).reshape(int(message.height), int(message.width), 3)


def field_from(message: Image) -> NDArray[np.float32]:
    """The (rows, columns, K) values of a ``32FC…`` image, (rows, columns) where K is 1.

    Raises:
        VolumeError: another encoding, big-endian values, no pixels, or fewer bytes than the stated
            size.
    """
    form = _FIELD.fullmatch(message.encoding)
    if form is None or message.is_bigendian:
        what = f"big-endian {message.encoding}" if message.is_bigendian else message.encoding
        raise VolumeError(f"the image is {what}; it must be 32FC1 to 32FC4, little-endian")
    count = int(form[1])
    values = np.ascontiguousarray(_lines(message, 4 * count)).view("<f4")
    rows, columns = int(message.height), int(message.width)
    return values.reshape((rows, columns) if count == 1 else (rows, columns, count))


def _lines(message: Image, size: int) -> NDArray[np.uint8]:
    """The bytes of an image, row by row, without what fills the rows up.

    Args:
        message: the image.
        size: bytes of a pixel.
    """
    rows, columns = int(message.height), int(message.width)
    step = int(message.step) or size * columns
    if not rows or not columns or step < size * columns or len(message.data) < rows * step:
        bytes_each = f" of {size} bytes" if size > 1 else ""
        raise VolumeError(
            f"the image holds {len(message.data)} bytes, but says it has {rows} rows of {columns} "
            f"pixels{bytes_each} in {step} bytes each"
        )
    flat = np.frombuffer(message.data, dtype=np.uint8, count=rows * step)
    return flat.reshape(rows, step)[:, : size * columns]


def affine_message(matrix: NDArray[np.floating]) -> Float64MultiArray:
    """A (4, 4) affine map, row after row."""
    message = Float64MultiArray()
    message.layout.dim = [
        MultiArrayDimension(label="row", size=4, stride=16),
        MultiArrayDimension(label="column", size=4, stride=4),
    ]
    message.data = packed("d", matrix.astype(np.float64))
    return message


def affine_from(message: Float64MultiArray) -> NDArray[np.float64]:
    """The (4, 4) affine map in a message.

    Raises:
        ProbeError: it is no 4 by 4 matrix, its last row is not 0 0 0 1, or a number of it is not
            finite, or so large that products of it would not be.
    """
    sizes = tuple(dimension.size for dimension in message.layout.dim)
    strides = tuple(dimension.stride for dimension in message.layout.dim)
    count, offset = len(message.data), message.layout.data_offset
    if sizes != (4, 4) or strides[1] != 4 or count != offset + 16:
        raise ProbeError(
            f"the matrix has {count} numbers from {offset} on in dimensions {list(sizes)} with "
            f"strides {list(strides)}; it must be 4 by 4, row after row (strides 16 and 4)"
        )
    matrix = np.array(message.data[offset:], dtype=np.float64).reshape(4, 4)
    if not ((np.abs(matrix) <= _LARGEST).all() and (matrix[3] == (0.0, 0.0, 0.0, 1.0)).all()):
        raise ProbeError(
            f"the matrix {matrix.tolist()} is not an affine map: give finite numbers, and "
            f"0 0 0 1 as the last row"
        )
    return matrix
