"""Export of a page's pictures as a video.

>>> import cv2, numpy as np
>>> from us_sim.viewer.export import encode_video
>>> picture = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
>>> encode_video([({"time": 0.0}, picture), ({"time": 1.0}, picture)])[4:8]
b'ftyp'
"""

from __future__ import annotations

import struct
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.errors import UsSimError
from us_sim.viewer.stream import Packet

Frame = tuple[Mapping[str, Any], bytes]
"""A header with the picture's ``time``, s, and the picture as JPEG."""

LARGEST = 2**28  # bytes of a page's message; the page itself keeps a third of that
RATE = 25.0  # pictures a second of a video, as a page's images come at uneven times
_LONGEST = 60.0  # s; a page keeps ten


def decode_frames(message: bytes) -> list[Frame]:
    """Decode the frames of a page's message.

    Args:
        message: a `Packet` with the frames' headers, each with its length as ``bytes``, and their
            payloads.

    Raises:
        UsSimError: there are no frames, or the lengths do not fit the payload.
    """
    frames: list[Frame] = []
    try:
        packet = Packet.from_bytes(message)
        payload = packet.payload
        for header in packet.header["frames"]:
            size = int(header["bytes"])
            frames.append((dict(header), payload[:size]))
            payload = payload[size:]
    except (struct.error, KeyError, TypeError, ValueError):
        frames = []
    if not frames or payload or not all(len(sent) == head["bytes"] for head, sent in frames):
        raise UsSimError("the page sent no frames that can be saved: load it again")
    return frames


def encode_video(frames: Sequence[Frame]) -> bytes:
    """Return the content of an MP4 file with these frames.

    Raises:
        UsSimError: the frames do not make a video, or OpenCV writes no MP4.
    """
    try:
        pictures = _resample(frames)
    except (KeyError, TypeError, ValueError, cv2.error) as error:
        raise UsSimError(f"these frames cannot be saved ({error}): load the page again") from error
    height, width = (max(picture.shape[axis] for picture in pictures) for axis in (0, 1))
    width, height = width + width % 2, height + height % 2  # the format wants even sizes
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "loop.mp4"
        codec = cv2.VideoWriter.fourcc(*"mp4v")
        writer = cv2.VideoWriter(str(file), codec, RATE, (width, height))
        if not writer.isOpened():
            raise UsSimError("this computer's OpenCV writes no MP4: save a PNG instead")
        for picture in pictures:
            rows, columns = picture.shape[:2]
            border = (0, height - rows, 0, width - columns)
            writer.write(cv2.copyMakeBorder(picture, *border, cv2.BORDER_CONSTANT))
        writer.release()
        return file.read_bytes()


def _resample(frames: Sequence[Frame]) -> list[NDArray[np.uint8]]:
    """Return the picture that was seen at each time of the video, `RATE` a second."""
    times = np.array([float(header["time"]) for header, _ in frames])
    times -= times[0]
    if not (np.isfinite(times).all() and (np.diff(times) >= 0.0).all() and times[-1] < _LONGEST):
        raise UsSimError("the times of these frames are not one after another")
    moments = np.arange(int(times[-1] * RATE) + 1) / RATE
    pictures = [_decode_jpeg(data) for _, data in frames]
    return [pictures[k] for k in np.searchsorted(times, moments + 1e-9, side="right") - 1]


def _decode_jpeg(data: bytes) -> NDArray[np.uint8]:
    """Decode a JPEG: (rows, columns, 3) of blue, green, red."""
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    if picture is None:
        raise UsSimError("a picture of the page is no JPEG: load the page again")
    return np.asarray(picture, dtype=np.uint8)
