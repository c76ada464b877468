"""What a bag that is being written holds: its topics, its closed files, and messages by topic."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from us_sim.errors import BagError
from us_sim.recording.mcap_output import McapOutput
from us_sim.recording.metadata import BagMetadata, FileEntry, TopicEntry
from us_sim.recording.qos import QosProfile, qos_to_yaml
from us_sim.recording.schemas import definitions, schema_text


@dataclass
class _Topic:
    """A topic being written."""

    type_name: str
    schema: str | None  # None where nobody knows it
    qos: tuple[QosProfile, ...]
    type_hash: str


class Contents:
    """Topics, closed files and counts, from which a bag's metadata are made."""

    def __init__(self) -> None:
        self.files: list[FileEntry] = []  # that are closed
        self._counts: Counter[str] = Counter()  # messages in those files, by topic
        self._topics: dict[str, _Topic] = {}

    @property
    def topics(self) -> tuple[str, ...]:
        """Names of the topics."""
        return tuple(self._topics)

    def __contains__(self, topic: str) -> bool:
        return topic in self._topics

    def add_topic(
        self,
        topic: str,
        type_name: str,
        qos: Sequence[object],
        type_hash: str | None,
        schema: str | None,
        *,
        defined: bool = True,
    ) -> bool:
        """Make a topic known, or add what is offered anew; whether it was not known.

        Raises:
            BagError: the name is none, or the type differs from before, or has no definition that
                can be understood and must be ``defined``.
        """
        if not topic or any(character.isspace() for character in topic):
            raise BagError(f"{topic!r} is not a topic name")
        profiles = tuple(map(QosProfile.of, qos))
        if (known := self._topics.get(topic)) is not None:
            if known.type_name != type_name:
                raise BagError(
                    f"topic {topic} is recorded as {known.type_name}: it cannot also be {type_name}"
                )
            known.qos = tuple(dict.fromkeys((*known.qos, *profiles)))
            return False
        try:
            schema = schema_text(type_name) if schema is None else schema
            if type_hash is None:
                type_hash = definitions(type_name, schema).hash_rihs01(type_name)
        except BagError:
            if defined:
                raise
        self._topics[topic] = _Topic(type_name, schema, profiles, type_hash or "")
        return True

    def introduce(self, topic: str, output: McapOutput) -> None:
        """Make a topic known to a file."""
        known = self._topics[topic]
        metadata = {
            "offered_qos_profiles": qos_to_yaml(known.qos),
            "topic_type_hash": known.type_hash,
        }
        output.add_topic(topic, known.type_name, known.schema, metadata)

    def keep(self, output: McapOutput) -> None:
        """Take a closed file into account."""
        self.files.append(_entry(output))
        self._counts += output.counts

    def metadata(self, present: McapOutput | None, custom_data: Mapping[str, str]) -> BagMetadata:
        """Of the closed files, and of the present one."""
        files, counts = [*self.files], self._counts
        if present is not None:
            files.append(_entry(present))
            counts = counts + present.counts
        filled = [file for file in files if file.message_count]
        start = min((file.start for file in filled), default=files[0].start)
        end = max((file.start + file.duration for file in filled), default=start)
        return BagMetadata(
            files=tuple(files),
            topics=tuple(
                TopicEntry(name, known.type_name, known.qos, known.type_hash, counts[name])
                for name, known in self._topics.items()
            ),
            start=start,
            duration=end - start,
            message_count=counts.total(),
            ros_distro=os.environ.get("ROS_DISTRO") or "jazzy",
            custom_data=custom_data,
        )


def _entry(output: McapOutput) -> FileEntry:
    if output.start is None or output.end is None:
        return FileEntry(output.path.name)
    duration = output.end - output.start
    return FileEntry(output.path.name, output.start, duration, output.message_count)
