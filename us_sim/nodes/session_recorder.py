"""Records every topic of the session, as it was serialized, to MCAP."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from us_sim.errors import BagError
from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.health import Health
from us_sim.nodes.parameters import declared
from us_sim.nodes.process import run_node
from us_sim.nodes.settings import SessionRecorderSettings
from us_sim.recording.writer import BagWriter

__all__ = ["SessionRecorder", "main"]

NOT_THE_SESSION = ("/rosout", "/parameter_events")
FOR_THE_EYE = ("tissue/structures", "ultrasound/image_annotated")
"""What is not computed either where only a recorder would want it."""
QUEUE = 1000
"""Messages a topic may be ahead of the disk."""


class SessionRecorder(GuardedNode):
    """Subscribes to each topic as soon as it appears, with the quality its publishers offer.

    Its parameters are those of `SessionRecorderSettings`. ``tissue/structures`` and
    ``ultrasound/image_annotated`` are recorded only where ``topics`` names them: they are large,
    and follow from the other topics.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("session_recorder", **kwargs)
        settings = declared(self, SessionRecorderSettings())
        file = settings.file
        compression: Any = settings.compression
        self._topics = set(settings.topics)
        self._excluded = {*settings.exclude, *NOT_THE_SESSION}
        self._excluded |= {self.resolve_topic_name(name) for name in FOR_THE_EYE} - self._topics
        self._refused: set[str] = set()
        self._subscribed: set[str] = set()
        taken = Path(file).with_name("metadata.yaml").exists()
        if taken:
            self.get_logger().info(
                "metadata.yaml in this folder belongs to another recording, so none is written; "
                "the file can be read and played without"
            )
        self._writer = BagWriter(file, compression=compression, sidecar=not taken)
        self.health = Health(self, str(file))
        self.health.state = "recording"
        self.create_timer(0.1, self._discover)
        self.create_timer(1.0, self._flush)
        self.get_logger().info(f"recording to {file}")

    def _discover(self) -> None:
        """Subscribe to what has appeared."""
        for topic, types in self.get_topic_names_and_types():
            known = topic in self._subscribed or topic in self._refused
            if known or topic in self._excluded or (self._topics and topic not in self._topics):
                continue
            offered = self.get_publishers_info_by_topic(topic)
            if not offered:
                continue
            try:
                self._subscribe(topic, types[0], [info.qos_profile for info in offered])
            except (BagError, ImportError, AttributeError) as error:
                self._refused.add(topic)
                self.health.problem("topic", f"{topic} ({types[0]}) is not recorded: {error}")

    def _subscribe(self, topic: str, type_name: str, offered: list[QoSProfile]) -> None:
        package, _, name = type_name.split("/")
        message_type = getattr(importlib.import_module(f"{package}.msg"), name)
        self._writer.add_topic(topic, type_name, offered)

        def write(data: bytes, info: Any) -> None:
            now = self.get_clock().now().nanoseconds
            self._write(topic, data, now, info["source_timestamp"])

        self.create_subscription(message_type, topic, write, _adopted(offered), raw=True)
        self._subscribed.add(topic)

    def _write(self, topic: str, data: bytes, received: int, sent: int) -> None:
        self.health.received += 1
        try:
            self._writer.write(topic, data, received, sent if sent > 0 else received)
        except BagError as error:
            self.health.problem("disk", str(error))
            return
        self.health.published(topic)

    def _flush(self) -> None:
        try:
            self._writer.flush()
        except BagError as error:
            self.health.problem("disk", str(error))

    def destroy_node(self) -> None:
        """Close the file, so that it has its index and metadata."""
        self._writer.close()
        super().destroy_node()


def _adopted(offered: list[QoSProfile]) -> QoSProfile:
    """What every one of the publishers can serve, as rosbag2 chooses it."""
    reliable = all(q.reliability == ReliabilityPolicy.RELIABLE for q in offered)
    latched = all(q.durability == DurabilityPolicy.TRANSIENT_LOCAL for q in offered)
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=QUEUE,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def main(args: list[str] | None = None) -> int:
    """Record until interrupted."""
    return run_node(SessionRecorder, args)


if __name__ == "__main__":
    sys.exit(main())
