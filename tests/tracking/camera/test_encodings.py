"""Every encoding of a driver against OpenCV's conversions to it, and the real tag in four."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from us_sim.errors import TrackingError
from us_sim.tracking.camera.encodings import decode_image, decompress_image

# Smooth, so that neither a Bayer pattern nor halved colours lose much of it.
ROWS, COLUMNS = np.mgrid[0:48, 0:64]
SCENE = np.stack([3 * COLUMNS + 30, 4 * ROWS + 20, 128 + ROWS - COLUMNS], axis=-1).astype(np.uint8)
GREY = cv2.cvtColor(SCENE, cv2.COLOR_RGB2GRAY)


def image(data, encoding, *, padding=0, big_endian=False, size=None):
    rows, columns = size or SCENE.shape[:2]
    data = np.pad(data, [(0, 0), (0, padding)])
    return SimpleNamespace(
        width=columns,
        height=rows,
        encoding=encoding,
        step=data.nbytes // len(data),
        is_bigendian=int(big_endian),
        data=data.tobytes(),
    )


def interleaved(first, second):
    return np.stack([first, second], axis=-1).reshape(len(first), -1)


def yuv():
    """(rows, columns) Y, and U and V of each two pixels, of the camera's range from 16 to 235."""
    r, g, b = np.moveaxis(SCENE / 255.0, -1, 0)
    y = 65.481 * r + 128.553 * g + 24.966 * b + 16
    u = -37.797 * r - 74.203 * g + 112 * b + 128
    v = 112 * r - 93.786 * g - 18.214 * b + 128
    return (np.round(each).astype(np.uint8) for each in (y, u, v))


Y, U, V = yuv()
UV = np.where(COLUMNS % 2, V, U).astype(np.uint8)
BAYER = {"rggb": "RGGB", "bggr": "BGGR", "gbrg": "GBRG", "grbg": "GRBG"}


def bayer(pattern):
    channel = np.array(["RGB".index(each) for each in pattern]).reshape(2, 2)
    return np.take_along_axis(SCENE, channel[ROWS % 2, COLUMNS % 2][..., None], axis=-1)[..., 0]


CASES = {
    "rgb8": SCENE.reshape(48, -1),
    "bgr8": SCENE[..., ::-1].reshape(48, -1),
    "rgba8": np.dstack([SCENE, GREY]).reshape(48, -1),
    "bgra8": np.dstack([SCENE[..., ::-1], GREY]).reshape(48, -1),
    "yuv422_yuy2": interleaved(Y, UV),
    "yuv422": interleaved(UV, Y),
    "uyvy": interleaved(UV, Y),
    "nv12": np.concatenate([Y, UV[::2]]),
    "nv21": np.concatenate([Y, np.where(COLUMNS % 2, U, V)[::2].astype(np.uint8)]),
    **{f"bayer_{name}8": bayer(pattern) for name, pattern in BAYER.items()},
    **{f"bayer_{name}16": bayer(p).astype("<u2") << 8 for name, p in BAYER.items()},
}


@pytest.mark.parametrize("encoding", CASES)
def test_an_image_has_its_greys_and_colours(encoding):
    message = image(CASES[encoding], encoding, padding=4)
    inner = (slice(2, -2), slice(2, -2))
    for colours, true in (("GRAY", GREY), ("RGB", SCENE)):
        found = decode_image(message, colours).astype(int)
        if colours == "GRAY" and ("yuv" in encoding or encoding in ("uyvy", "nv12", "nv21")):
            true = Y  # OpenCV gives the camera's own grey
        assert found.shape == true.shape
        assert np.abs(found - true)[inner].max() <= 8


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
@pytest.mark.parametrize("big_endian", [False, True])
def test_sixteen_bits_are_as_many_as_the_sensor_has(bits, big_endian):
    values = np.linspace(0, 2**bits - 1, 48 * 64).reshape(48, 64)
    data = values.astype(">u2" if big_endian else "<u2")
    found = decode_image(image(data, "mono16", big_endian=big_endian), "GRAY")
    np.testing.assert_array_equal(found, data >> (bits - 8))
    png = cv2.imencode(".png", data.astype(np.uint16))[1].tobytes()
    seen = decompress_image(SimpleNamespace(format="png", data=png), "GRAY")
    np.testing.assert_array_equal(seen, found)


def test_compressed_colours_are_red_green_and_blue():
    data = cv2.imencode(".jpg", SCENE[..., ::-1])[1].tobytes()
    message = SimpleNamespace(format="jpeg", data=data)
    assert np.abs(decompress_image(message, "RGB").astype(int) - SCENE).mean() < 3
    assert np.abs(decompress_image(message, "GRAY").astype(int) - GREY).mean() < 2


@pytest.mark.parametrize(
    ("message", "word"),
    [
        (image(GREY, "jpeg2000"), "jpeg2000"),
        (image(GREY[:30], "mono8", size=(48, 64)), "bytes"),
        (image(Y, "nv12"), "bytes"),
        (image(GREY[:, :63], "nv12", size=(32, 63)), "cannot be"),
    ],
)
def test_what_is_no_such_image_is_refused(message, word):
    with pytest.raises(TrackingError, match=word):
        decode_image(message, "GRAY")


def test_what_is_no_jpeg_or_png_is_refused():
    for data in (b"", b"GIF89a"):
        with pytest.raises(TrackingError, match="decoded"):
            decompress_image(SimpleNamespace(format="jpeg", data=data), "GRAY")
