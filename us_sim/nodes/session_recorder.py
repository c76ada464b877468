"""A recorder of all topics of a session to MCAP, as they were serialized."""

from __future__ import annotations

import contextlib
import functools
import os
import shutil
import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rclpy.executors import SingleThreadedExecutor
from rclpy.type_support import check_for_type_support
from rosbags.interfaces import Qos

from us_sim.errors import BagError
from us_sim.nodes.guarded_node import GuardedNode, Health
from us_sim.nodes.parameters import LiveSettings
from us_sim.nodes.process import node_main, raise_receiver_priority, signals_wait
from us_sim.nodes.sessions.attachments import collect_attachments
from us_sim.nodes.sessions.recorded_topic import RecordedTopic, message_type
from us_sim.nodes.settings import SessionRecorderSettings
from us_sim.nodes.topics import TOPICS
from us_sim.recording.schemas import compute_type_hash, normalize_type
from us_sim.recording.topic import qos_of
from us_sim.recording.write_behind import WriteBehind
from us_sim.recording.writer import BagWriter
from us_sim.settings.spelling import format_count

_RESERVE = 16 * 1024 * 1024  # bytes of the disk, for the index of some hours
_WITHOUT_METADATA = (
    "metadata.yaml in this folder belongs to another recording, so none is written; the file can "
    "be read and played without"
)


class SessionRecorder(GuardedNode):
    """Subscribes to each topic as soon as it appears, with the quality its publishers offer.

    Its parameters are those of `SessionRecorderSettings`, its service is ``~/stop``. Topics that
    are made on demand, such as ``ultrasound/image_annotated``, are recorded only if ``topics`` or
    ``also`` names them: they are large, and follow from others.
    """

    executor_class = SingleThreadedExecutor  # rclpy's EventsExecutor hands on no message's number

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("session_recorder", **kwargs)
        live = LiveSettings(self, {"recorder": SessionRecorderSettings()}, use=self._use)
        settings: SessionRecorderSettings = live.values["recorder"]
        self._settings = settings
        self._is_wanted = functools.cache(
            lambda topic: settings.records_topic(topic, self.get_namespace())
        )
        _load_types()
        self._attachments = collect_attachments(settings)
        self._refused: set[tuple[str, str]] = set()  # topics of a type
        self._topics: dict[str, RecordedTopic] = {}
        self._reported: Counter[str] = Counter()  # losses
        self._bag: WriteBehind | None = None  # None once it was stopped
        self._latched: dict[str, tuple[str, bytes, int, int]] = {}  # that came while it was paused
        self.health = Health(self, settings.file)
        self.health.measure = self._measure
        self._begin()
        self.create_command("stop", self.stop_recording)
        self.create_timer(0.1, self._discover)
        self.create_timer(1.0, self._follow_publishers)

    def _use(self, values: Mapping[str, SessionRecorderSettings]) -> None:
        """Pause or go on, as the parameter says."""
        self._settings = values["recorder"]
        if self._bag is not None and not self._settings.paused:
            for kept in self._latched.values():
                self._bag.put_message(*kept)
            self._latched.clear()
        self._update_state()

    def stop_recording(self) -> str:
        """End the recording, so that its file gets its index; return why that fails, or nothing."""
        if self._bag is None:
            return "nothing is recorded any more"
        for topic in self._topics.values():
            with contextlib.suppress(Exception):  # what the rest raises must not cost what is there
                topic.take_remaining()
        bag, self._bag = self._bag, None
        problem = ""
        try:
            bag.close()
        except BagError as error:
            problem = str(error)
        with contextlib.suppress(Exception):  # ROS may be shut down already
            if problem:
                self.health.count_problem("disk", problem)
            self._report_losses(bag)
            self._update_state()
        return ""

    def destroy_node(self) -> None:
        """Close the file, so that it has its index and metadata."""
        self.stop_recording()
        super().destroy_node()

    def _begin(self) -> None:
        settings = self._settings
        goes_on = settings.if_exists == "further"
        taken = os.path.exists(Path(settings.file).parent / "metadata.yaml")
        taken = taken and settings.file.endswith(".mcap")
        if taken and not goes_on:
            self._note(_WITHOUT_METADATA)
        compression: Any = settings.compression
        bag = BagWriter(
            settings.file,
            compression=compression,
            sidecar=not taken,
            further=goes_on,
            reserve=_RESERVE,
        )
        if goes_on and (gap := _gap_before(bag.path, Path(settings.file).stem)):
            self._note(f"it goes on in {bag.path.name}: {gap:.1f} s before that are not recorded")
        self._bag = WriteBehind(bag, settings.max_cache_size)
        self._file, self._began = Path(bag.path).absolute(), time.monotonic()
        now = self.get_clock().now().nanoseconds
        for name, (media_type, data) in self._attachments.items():
            self._bag.attach_file(name, media_type, data, now)
        self._update_state()
        self.get_logger().info(f"recording to {bag.path}")

    def _measure(self) -> dict[str, str]:
        """Return the file, its duration and size, and the room that is left."""
        values = {"file": str(self._file), "seconds": f"{time.monotonic() - self._began:.0f}"}
        with contextlib.suppress(OSError):  # it was taken away
            values["bytes"] = str(self._file.stat().st_size)
            values["room_bytes"] = str(shutil.disk_usage(self._file.parent).free)
        return values

    def _note(self, sentence: str) -> None:
        """Log a sentence about the file, and put it in diagnostics."""
        self.health.values["note"] = sentence
        self.get_logger().info(sentence)

    def _discover(self) -> None:
        has_time = bool(self.get_clock().now().nanoseconds)  # simulated time has begun
        for topic, types in self.get_topic_names_and_types() if has_time else ():
            if not self._is_wanted(topic):
                continue
            for type_name in types:
                known = self._topics.get(topic)
                if (known and type_name == known.type_name) or (topic, type_name) in self._refused:
                    continue
                try:
                    self._subscribe(topic, type_name)
                except Exception as error:  # the names on a network may be anything
                    self._refused.add((topic, type_name))
                    self.health.count_problem("topic", f"{topic} is not recorded: {error}")

    def _subscribe(self, topic: str, type_name: str) -> None:
        if known := self._topics.get(topic):
            raise BagError(f"it is recorded as {known.type_name} and cannot be {type_name}, too")
        offered = self._offered(topic, type_name)
        if not offered:
            return
        recorded = RecordedTopic(self, topic, type_name, offered, self._on_message, self._on_loss)
        if self._bag is not None:
            self._bag.add_topic(topic, type_name, offered)
        self._topics[topic] = recorded

    def _offered(self, topic: str, type_name: str) -> list[Qos]:
        """Return the quality of service of the topic's publishers of that type."""
        publishers = self.get_publishers_info_by_topic(topic)
        return [qos_of(each.qos_profile) for each in publishers if each.topic_type == type_name]

    def _on_message(self, topic: str, data: bytes, info: Mapping[str, Any]) -> None:
        self.health.received += 1
        now = self._time_of_arrival(info)
        sent = info["source_timestamp"]
        message = topic, data, now, sent if sent > 0 else now
        if self._bag is None:
            return
        if not self._settings.paused:
            if self._bag.put_message(*message):
                self.health.count_published(topic)
        elif self._topics[topic].is_latched:
            self._latched[topic] = message

    def _time_of_arrival(self, info: Mapping[str, Any]) -> int:
        """Return the time (ns) at which the middleware got a message; a busy recorder is later."""
        received: int = info.get("received_timestamp") or 0
        is_known = received > 0 and not self.is_time_simulated  # which is another clock's
        return received if is_known else int(self.get_clock().now().nanoseconds)

    def _on_loss(self, topic: str, count: int) -> None:
        if self._bag is not None and not self._settings.paused:
            self._bag.count_lost(topic, count)

    def _follow_publishers(self) -> None:
        for topic in self._topics.values():
            new = topic.adopt_offers(self._offered(topic.name, topic.type_name))
            if new and self._bag is not None:
                self._bag.add_topic(topic.name, topic.type_name, new)
        self.health.fault = "" if self._bag is None else self._bag.problem
        if self._bag is not None:
            self._report_losses(self._bag)

    def _report_losses(self, bag: WriteBehind) -> None:
        lost = bag.losses
        new, self._reported = lost - self._reported, lost
        self.health.dropped = lost.total()
        while bag.untold:
            self.health.count_problem("disk", bag.untold.popleft())
        if new:
            self.health.count_problem(
                "lost", f"{format_count(new.total(), 'message')} of {', '.join(new)} not recorded"
            )

    def _update_state(self) -> None:
        active = "paused" if self._settings.paused else "recording"
        self.health.state = "stopped" if self._bag is None else active


def _gap_before(file: Path, stem: str) -> float:
    """Return the s since earlier files whose names begin with ``stem`` were written, or 0."""
    before = [each for each in file.parent.glob("*.mcap") if each.name.startswith(stem)]
    written = [each.stat().st_mtime for each in before if each != file]
    return time.time() - max(written) if written else 0.0


def _load_types() -> None:
    """Import the types of the graph's messages now, before messages come."""
    for type_name in {topic.type_name for topic in TOPICS}:
        with contextlib.suppress(BagError):  # not every type is everywhere
            cls = message_type(normalize_type(type_name))
            check_for_type_support(cls)
            compute_type_hash(normalize_type(type_name))


def _create() -> SessionRecorder:
    signals_wait.set()  # a file that is begun gets its end
    node = SessionRecorder()
    raise_receiver_priority()
    return node


main = node_main(_create, __name__)
