"""The images of ``ultrasound/…``, as pixels or as JPEG, and where the pixels are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import Image
from std_msgs.msg import Float64MultiArray

from us_sim.errors import VolumeError
from us_sim.nodes.conversions import affine_from, colour_pixels_from, nanoseconds_of, pixels_from
from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.posted import Posted
from us_sim.nodes.qos import LATCHED
from us_sim.nodes.viewer_feeds.watched_topic import Make, WatchedTopic
from us_sim.viewer.feed import Feed
from us_sim.viewer.packet import Packet

__all__ = ["image_feeds"]

_QUALITY = 90
"""Of JPEG: 512 × 512 pixels of speckle are 60 kB then, a quarter of what they were."""
_COLOURS = {
    "annotated": "ultrasound/image_annotated",
    "m_mode": "ultrasound/m_mode",
    "spectrum": "ultrasound/spectrum",
}
"""Streams of pictures in colour, and their topics."""


AskedBy = Callable[[int], tuple[str, int] | None]


def image_feeds(
    node: GuardedNode, post: Posted, rate: float, asked_by: AskedBy = lambda _: None
) -> list[Feed]:
    """The B-mode image as ``image`` and ``image_jpeg``, its ``image_geometry``, and pictures.

    Args:
        node: that subscribes.
        post: has work done in the node's thread.
        rate: Hz, of images, at most, for each page.
        asked_by: the page, and its number for it, of the last wish that is seen in the image of a
            stamp, ns; so the page can tell how long that took.
    """

    def answering(make: Make) -> Make:
        def answer(message: Image, sequence: int) -> Packet:
            packet = make(message, sequence)
            asked = asked_by(int(packet.header["stamp"]))
            told = {} if asked is None else {"command": list(asked)}
            return replace(packet, header={**packet.header, **told})

        return answer

    def images(topic: str, kind: str, make: Make) -> Feed:
        return WatchedTopic(node, post, Image, topic, make, kind, rate).feed

    geometry = WatchedTopic(
        *(node, post, Float64MultiArray, "ultrasound/image_to_probe", _geometry, "image_geometry"),
        rate=None,
        qos=LATCHED,
    )
    return [
        images("ultrasound/image", "image", answering(_pixels)),
        images("ultrasound/image", "image_jpeg", answering(_grey_jpeg)),
        *(images(topic, kind, _colour_jpeg(kind)) for kind, topic in _COLOURS.items()),
        geometry.feed,
    ]


def _pixels(message: Image, sequence: int) -> Packet:
    pixels = np.ascontiguousarray(pixels_from(message))
    return Packet("image", sequence, _header(message, "mono8"), pixels.tobytes())


def _grey_jpeg(message: Image, sequence: int) -> Packet:
    return _jpeg(message, "image_jpeg", sequence, pixels_from(message))


def _colour_jpeg(kind: str) -> Make:
    def make(message: Image, sequence: int) -> Packet:
        pixels = cv2.cvtColor(colour_pixels_from(message), cv2.COLOR_RGB2BGR)
        return _jpeg(message, kind, sequence, pixels)

    return make


def _jpeg(message: Image, kind: str, sequence: int, pixels: NDArray[Any]) -> Packet:
    done, encoded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    if not done:
        raise VolumeError("the image cannot be made a JPEG")
    return Packet(kind, sequence, _header(message, "jpeg"), encoded.tobytes())


def _header(message: Image, encoding: str) -> dict[str, Any]:
    stamp = str(nanoseconds_of(message.header.stamp))  # more digits than a number of JavaScript
    rows, columns = int(message.height), int(message.width)
    return {"stamp": stamp, "rows": rows, "columns": columns, "encoding": encoding}


def _geometry(message: Float64MultiArray, sequence: int) -> Packet:
    matrix = affine_from(message)
    return Packet("image_geometry", sequence, {"matrix": matrix.ravel().tolist()}, b"")
