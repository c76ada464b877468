"""Waits for images, and notes when each message on the way to them arrives."""

from __future__ import annotations

import struct
import time
from collections.abc import Sequence
from functools import partial
from typing import Any

from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from sensor_msgs.msg import Image, PointCloud2

from us_sim.nodes.qos import EVERY

HOPS = {
    "tracker/pose": PoseStamped,
    "probe/pose": PoseStamped,
    "tissue/nodes": PointCloud2,
    "skin/nodes": PointCloud2,
    "ultrasound/image": Image,
}
"""Topics that carry the stamp of the tracker's pose, in the order of the graph."""

_HEADER = struct.Struct("<4xiI")  # where a serialized message with a header has its stamp


def read_stamp(data: bytes) -> int:
    """The stamp, ns, of a serialized message with a header."""
    seconds, nanoseconds = _HEADER.unpack_from(data)
    return int(1_000_000_000 * seconds + nanoseconds)


class Arrivals(Node):  # type: ignore[misc]
    """Subscribes to topics without looking at more of their messages than the stamps."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("arrivals", **kwargs)
        self._heard: dict[str, list[tuple[int, int]]] = {topic: [] for topic in HOPS}
        for topic, kind in HOPS.items():
            note = partial(self._record_arrival, self._heard[topic])
            self.create_subscription(kind, topic, note, EVERY, raw=True)

    def list_arrivals(self, topic: str) -> Sequence[tuple[int, int]]:
        """Stamp and time of arrival of every message so far, ns."""
        return list(self._heard[topic])

    def list_arrivals_between(self, began: int, ended: int) -> dict[str, list[tuple[int, int]]]:
        """Stamps and arrivals by topic, of messages stamped from ``began`` until ``ended``, ns."""
        return {
            topic: [each for each in self.list_arrivals(topic) if began <= each[0] < ended]
            for topic in self._heard
        }

    @staticmethod
    def _record_arrival(heard: list[tuple[int, int]], data: bytes) -> None:
        heard.append((read_stamp(data), time.time_ns()))
