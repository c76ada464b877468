"""The images of ``ultrasound/…``, as pixels or as JPEG, with what is known of each."""

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
from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.messages import affine_from, colour_pixels_from, nanoseconds_of, pixels_from
from us_sim.nodes.posted import Posted
from us_sim.nodes.qos import LATCHED
from us_sim.nodes.viewer_feeds.watched_topic import Make, WatchedTopic
from us_sim.viewer.feed import Feed
from us_sim.viewer.packet import Packet

_QUALITY = 90
"""Of JPEG: 512 × 512 pixels of speckle are 60 kB then, a quarter of what they were."""
_STRIPS = {"m_mode": "ultrasound/m_mode", "spectrum": "ultrasound/spectrum"}
"""Streams of what runs over time, and their topics."""

Known = Callable[[int], dict[str, Any]]


def image_feeds(
    node: GuardedNode,
    post: Posted,
    rate: float,
    known: Known = lambda _: {},
    arranged: Callable[[], tuple[bool, bool]] = lambda: (False, False),
) -> list[Feed]:
    """The B-mode image as ``image`` and ``image_jpeg``, and pictures in colour.

    The header of a B-mode image, and of the annotated one, says where its pixels are (``matrix``).

    Args:
        node: that subscribes.
        post: has work done in the node's thread.
        rate: Hz, of images, at most, for each page.
        known: what else is known of the image of a stamp, ns, for its header.
        arranged: whether left and right are to be exchanged, as in the annotated image, and
            whether that has the B-mode image at its left.
    """
    places: list[NDArray[np.float64]] = []

    def place(message: Float64MultiArray) -> None:
        places[:] = [affine_from(message)]

    node.create_subscription(Float64MultiArray, "ultrasound/image_to_probe", place, LATCHED)

    def telling(make: Callable[[Image, int, bool], Packet]) -> Make:
        def tell(message: Image, sequence: int) -> Packet:
            flip, is_beside = arranged()
            packet = make(message, sequence, flip)
            header = {**packet.header, **known(int(packet.header["stamp"]))}
            panels = 2 if is_beside and packet.kind == "annotated" else 1
            if panels > 1:
                header["panels"] = panels
            for matrix in places:
                columns = int(header["columns"]) // panels
                of_pixels = _flipped(matrix, columns) if flip else matrix
                header["matrix"] = of_pixels.ravel().tolist()
            return replace(packet, header=header)

        return tell

    def images(topic: str, kind: str, make: Make) -> Feed:
        return WatchedTopic(node, post, Image, topic, make, kind, rate).feed

    annotated = _colour_jpeg("annotated")
    return [
        images("ultrasound/image", "image", telling(_pixels)),
        images("ultrasound/image", "image_jpeg", telling(_grey_jpeg)),
        images("ultrasound/image_annotated", "annotated", telling(lambda m, n, _: annotated(m, n))),
        *(images(topic, kind, _colour_jpeg(kind)) for kind, topic in _STRIPS.items()),
    ]


def _pixels(message: Image, sequence: int, flip: bool) -> Packet:
    return Packet("image", sequence, _header(message, "mono8"), _grey(message, flip).tobytes())


def _grey_jpeg(message: Image, sequence: int, flip: bool) -> Packet:
    return _jpeg(message, "image_jpeg", sequence, _grey(message, flip))


def _grey(message: Image, flip: bool) -> NDArray[np.uint8]:
    pixels = pixels_from(message)
    return np.ascontiguousarray(pixels[:, ::-1] if flip else pixels)


def _flipped(matrix: NDArray[np.float64], columns: int) -> NDArray[np.float64]:
    """From (column, row, 0, 1) of the image whose left and right are exchanged."""
    exchange = np.diag([-1.0, 1.0, 1.0, 1.0])
    exchange[0, 3] = columns - 1
    return matrix @ exchange


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
