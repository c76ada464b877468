"""Videos that a page saves, read back by OpenCV."""

import json
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from us_sim.errors import UsSimError
from us_sim.viewer.export import decode_frames, encode_video
from us_sim.viewer.stream import Packet


def pictures(times: list[float], sizes: list[tuple[int, int]]) -> list[Any]:
    """JPEGs whose grey value is 20 times their number."""
    return [
        ({"time": at}, cv2.imencode(".jpg", np.full((*size, 3), 20 * k, np.uint8))[1].tobytes())
        for k, (at, size) in enumerate(zip(times, sizes, strict=True))
    ]


def test_a_loop_plays_as_fast_as_it_came(tmp_path: Path) -> None:
    times = [100.0, 100.1, 100.9, 102.0]
    file = tmp_path / "loop.mp4"
    file.write_bytes(encode_video(pictures(times, [(120, 160)] * 3 + [(131, 160)])))
    film, greys = cv2.VideoCapture(str(file)), []
    while (read := film.read())[0]:
        greys.append(read[1][:100].mean())
    for at, grey in ((0.04, 0), (0.5, 20), (1.5, 40), (2.0, 60)):
        assert greys[round(at * film.get(cv2.CAP_PROP_FPS))] == pytest.approx(grey, abs=3)


@pytest.mark.parametrize(
    "frames",
    [
        [({"time": 0.0}, b"no picture")],
        [({"time": 0.0}, b"")],
        [({"time": "now"}, b"no time")],
        [({}, b"no time")],
        pictures([0.0, -1.0], [(8, 8)] * 2),
        pictures([0.0, 1e9], [(8, 8)] * 2),
    ],
)
def test_what_cannot_be_saved_is_refused(frames: list[Any]) -> None:
    with pytest.raises(UsSimError):
        encode_video(frames)


@pytest.mark.parametrize(
    "message",
    [
        b"",
        struct.pack("<I", 2) + b"{}",
        *(
            Packet("mp4", 0, {"frames": frames}, b"1234").encoded
            for frames in ([], [{"bytes": 5}], [{"bytes": -1}], 7)
        ),
    ],
)
def test_a_message_without_frames_is_refused(message: bytes) -> None:
    with pytest.raises(UsSimError, match="no frames"):
        decode_frames(message)


def test_frames_come_apart_as_they_were_sent() -> None:
    told = {"frames": [{"bytes": 1, "a": 1}, {"bytes": 3, "a": 2}]}
    frames = decode_frames(Packet("mp4", 0, json.loads(json.dumps(told)), b"wxyz").encoded)
    assert [(header["a"], sent) for header, sent in frames] == [(1, b"w"), (2, b"xyz")]
