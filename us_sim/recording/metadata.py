"""The ``metadata.yaml`` of a bag (version 9), written to the letter as ROS 2 Jazzy does."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import yaml

from us_sim.errors import BagError
from us_sim.recording.topic import QosProfile, qos_from_yaml
from us_sim.settings.text_files import YamlError, load_yaml, read_text

_NEWEST_VERSION = 9
_NO_TIME = 2**63 - 1  # ns, the starting time that rosbag2 gives a bag without messages


@dataclass(frozen=True)
class FileEntry:
    """One file of a bag; its path is relative to the bag's folder."""

    path: str
    start: int = _NO_TIME  # ns since the epoch, lowest log time
    duration: int = 0  # ns
    message_count: int = 0


@dataclass(frozen=True)
class TopicEntry:
    """One topic of a bag."""

    name: str
    type_name: str
    qos: tuple[QosProfile, ...] = ()
    type_hash: str = ""
    message_count: int = 0
    encoding: str = "cdr"


@dataclass(frozen=True)
class BagMetadata:
    """Contents of a ``metadata.yaml``."""

    files: tuple[FileEntry, ...]
    topics: tuple[TopicEntry, ...] = ()
    start: int = _NO_TIME  # ns since the epoch, lowest log time
    duration: int = 0  # ns
    message_count: int = 0
    storage: str = "mcap"
    compression_format: str = ""
    compression_mode: str = ""  # "", "FILE" or "MESSAGE"
    ros_distro: str = "jazzy"
    custom_data: Mapping[str, str] = field(default_factory=dict)

    def document(self) -> str:
        """The text of the file."""
        return "rosbag2_bagfile_information:\n" + "\n".join(_indented(self.lines(), 2))

    def lines(self) -> list[str]:
        """The lines that rosbag2 also stores inside an MCAP file, without the outer key."""
        lines = [
            f"version: {_NEWEST_VERSION}",
            f"storage_identifier: {self.storage}",
            *_extent(self.start, self.duration, start_first=False),
            f"message_count: {self.message_count}",
            "topics_with_message_count:",
            *_sequence(_topic_lines(topic) for topic in self.topics),
            f"compression_format: {_scalar(self.compression_format)}",
            f"compression_mode: {_scalar(self.compression_mode)}",
            "relative_file_paths:",
            *_sequence([_scalar(file.path)] for file in self.files),
            "files:",
            *_sequence(_file_lines(file) for file in self.files),
        ]
        if self.custom_data:
            lines.append("custom_data:")
            lines += [f"  {_scalar(k)}: {_scalar(v)}" for k, v in self.custom_data.items()]
        else:
            lines.append("custom_data: ~")
        lines.append(f"ros_distro: {_scalar(self.ros_distro)}")
        return lines


def read_metadata(file: Path) -> BagMetadata:
    """Reads a ``metadata.yaml`` of any version up to 9.

    Raises:
        BagError: it cannot be read, is not such a file, or is of a newer version.
    """
    try:
        document = load_yaml(read_text(file))
        information = document["rosbag2_bagfile_information"]
        version = int(information["version"])
        if version > _NEWEST_VERSION:
            raise BagError(
                f"{file} is of version {version}, newer than the {_NEWEST_VERSION} that is known "
                f"here: convert the bag with ros2 bag convert of ROS 2 Jazzy"
            )
        return BagMetadata(
            files=tuple(FileEntry(str(path)) for path in information["relative_file_paths"] or ()),
            topics=tuple(
                _topic_entry(item, file) for item in information["topics_with_message_count"] or ()
            ),
            start=int(information["starting_time"]["nanoseconds_since_epoch"]),
            duration=int(information["duration"]["nanoseconds"]),
            message_count=int(information["message_count"]),
            storage=str(information["storage_identifier"]),
            compression_format=str(information.get("compression_format") or ""),
            compression_mode=str(information.get("compression_mode") or "").upper(),
            ros_distro=str(information.get("ros_distro") or ""),
            custom_data=dict(information.get("custom_data") or {}),
        )
    except OSError as error:
        raise BagError(f"{file} cannot be read: {error.strerror}") from None
    except KeyError as error:
        raise BagError(f"{file} is not the metadata of a bag: it lacks {error}") from None
    except (
        YamlError,
        UnicodeDecodeError,
        TypeError,
        ValueError,
        AttributeError,
        OverflowError,
    ) as error:
        reason = str(error).splitlines()[0]
        raise BagError(f"{file} is not the metadata of a bag: {reason}") from None


def _topic_entry(item: Mapping, file: Path) -> TopicEntry:
    topic = item["topic_metadata"]
    return TopicEntry(
        name=str(topic["name"]),
        type_name=str(topic["type"]),
        qos=qos_from_yaml(topic.get("offered_qos_profiles"), f"{file}, {topic['name']}"),
        type_hash=str(topic.get("type_description_hash") or ""),
        message_count=int(item["message_count"]),
        encoding=str(topic["serialization_format"]),
    )


def _topic_lines(topic: TopicEntry) -> list[str]:
    return [
        "topic_metadata:",
        f"  name: {_scalar(topic.name)}",
        f"  type: {_scalar(topic.type_name)}",
        f"  serialization_format: {_scalar(topic.encoding)}",
        "  offered_qos_profiles:",
        *_indented(_sequence(profile.lines() for profile in topic.qos), 2),
        f"  type_description_hash: {_scalar(topic.type_hash)}",
        f"message_count: {topic.message_count}",
    ]


def _file_lines(file: FileEntry) -> list[str]:
    return [
        f"path: {_scalar(file.path)}",
        *_extent(file.start, file.duration, start_first=True),
        f"message_count: {file.message_count}",
    ]


def _extent(start: int, duration: int, *, start_first: bool) -> list[str]:
    start_lines = ["starting_time:", f"  nanoseconds_since_epoch: {start}"]
    duration_lines = ["duration:", f"  nanoseconds: {duration}"]
    return start_lines + duration_lines if start_first else duration_lines + start_lines


def _sequence(items: Iterable[list[str]]) -> list[str]:
    """YAML lines of a block sequence, indented under its key as yaml-cpp does."""
    lines: list[str] = []
    for first, *rest in items:
        lines += [f"  - {first}", *_indented(rest, 4)]
    return lines or ["  []"]


def _indented(lines: Iterable[str], columns: int) -> list[str]:
    return [" " * columns + line for line in lines]


def _scalar(text: str) -> str:
    """A plain scalar where YAML reads it back as the same string, else a double-quoted one."""
    plain = re.fullmatch(r"[\w/~.][\w/~. {}-]*(?<! )", text, re.ASCII)
    if plain and _LOADER(text).get_single_data() == text:
        return text
    return json.dumps(text, ensure_ascii=False)


_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
