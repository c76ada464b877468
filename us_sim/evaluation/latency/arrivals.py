"""A node that records the arrival of each message from a pose to its image."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from typing import Any

from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from sensor_msgs.msg import Image, PointCloud2

from us_sim.nodes.qos import EVERY
from us_sim.recording.decoding import read_stamp

HOPS = {
    "tracker/pose": PoseStamped,
    "probe/pose": PoseStamped,
    "tissue/nodes": PointCloud2,
    "skin/nodes": PointCloud2,
    "ultrasound/image": Image,
}
"""Topics that carry the stamp of the tracker's pose, in the order of the graph."""


class Arrivals(Node):  # type: ignore[misc]
    """Stamps and times of arrival of the messages of `HOPS`; it reads only the stamps."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("arrivals", **kwargs)
        self._arrivals: dict[str, list[tuple[int, int]]] = {topic: [] for topic in HOPS}
        for topic, kind in HOPS.items():
            record = partial(self._record_arrival, self._arrivals[topic])
            self.create_subscription(kind, topic, record, EVERY, raw=True)

    def list_arrivals(self, topic: str) -> Sequence[tuple[int, int]]:
        """Return stamp and time of arrival (ns) of every message so far."""
        return list(self._arrivals[topic])

    def list_arrivals_between(self, began: int, ended: int) -> dict[str, list[tuple[int, int]]]:
        """Return arrivals by topic, of messages with stamps from ``began`` until ``ended`` (ns)."""
        return {
            topic: [each for each in self.list_arrivals(topic) if began <= each[0] < ended]
            for topic in HOPS
        }

    @staticmethod
    def _record_arrival(arrivals: list[tuple[int, int]], data: bytes) -> None:
        arrivals.append((read_stamp(data), time.time_ns()))
