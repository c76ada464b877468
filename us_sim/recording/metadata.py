"""The ``metadata.yaml`` of a bag: version 9, as ROS 2 Jazzy writes it, and every older one."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rosbags.rosbag2.metadata import dump_qos_v9

from us_sim.errors import BagError
from us_sim.recording.schemas import normalized_type
from us_sim.recording.topic import BagTopic, as_yaml, qos_from_yaml
from us_sim.settings.text_files import YamlError, load_yaml

_KEY = "rosbag2_bagfile_information"
_NEWEST_VERSION = 9
NO_TIME = 2**63 - 1  # ns, the starting time that rosbag2 gives a bag without messages


@dataclass(frozen=True)
class BagMetadata:
    """Contents of a ``metadata.yaml``."""

    files: tuple[str, ...]  # relative to the bag's folder
    topics: tuple[BagTopic, ...] = ()
    start: int = NO_TIME  # ns since the epoch, lowest log time
    duration: int = 0  # ns
    message_count: int = 0
    compression_mode: str = ""  # "", "FILE" or "MESSAGE"

    def document(self) -> str:
        """Return the text of the file, for a bag of one MCAP file."""
        return as_yaml({_KEY: self.information()})

    def information(self) -> dict[str, Any]:
        """Return what rosbag2 also stores inside an MCAP file, without the outer key."""
        extent = {
            "starting_time": {"nanoseconds_since_epoch": self.start},
            "duration": {"nanoseconds": self.duration},
            "message_count": self.message_count,
        }
        return {
            "version": _NEWEST_VERSION,
            "storage_identifier": "mcap",
            **extent,
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": topic.name,
                        "type": topic.type_name,
                        "serialization_format": topic.encoding,
                        "offered_qos_profiles": dump_qos_v9([*topic.qos]),
                        "type_description_hash": topic.type_hash,
                    },
                    "message_count": topic.message_count,
                }
                for topic in self.topics
            ],
            "compression_format": "",
            "compression_mode": self.compression_mode,
            "relative_file_paths": [*self.files],
            "files": [{"path": file, **extent} for file in self.files],
            "custom_data": None,
            "ros_distro": os.environ.get("ROS_DISTRO") or "jazzy",
        }


def read_metadata(file: Path) -> BagMetadata:
    """Read a ``metadata.yaml`` of any version up to 9.

    Raises:
        BagError: it cannot be read, is not such a file, or is of a newer version.
    """
    try:
        document = load_yaml(file.read_text(encoding="utf-8"))
        information = document[_KEY]
        version = int(information["version"])
        if version > _NEWEST_VERSION:
            raise BagError(
                f"{file} is of version {version}, newer than the {_NEWEST_VERSION} that is known "
                f"here: convert the bag with ros2 bag convert of ROS 2 Jazzy"
            )
        return BagMetadata(
            files=tuple(map(str, information["relative_file_paths"] or ())),
            topics=tuple(
                _topic(item, file) for item in information["topics_with_message_count"] or ()
            ),
            start=int(information["starting_time"]["nanoseconds_since_epoch"]),
            duration=int(information["duration"]["nanoseconds"]),
            message_count=int(information["message_count"]),
            compression_mode=str(information.get("compression_mode") or "").upper(),
        )
    except OSError as error:
        raise BagError(f"{file} cannot be read: {error.strerror}") from None
    except KeyError as error:
        raise BagError(f"{file} is not the metadata of a bag: it lacks {error}") from None
    except (YamlError, TypeError, ValueError, AttributeError) as error:
        reason = str(error).splitlines()[0]
        raise BagError(f"{file} is not the metadata of a bag: {reason}") from None


def _topic(item: Mapping, file: Path) -> BagTopic:
    topic = item["topic_metadata"]
    return BagTopic(
        name=str(topic["name"]),
        type_name=normalized_type(str(topic["type"])),
        message_count=int(item["message_count"]),
        qos=qos_from_yaml(topic.get("offered_qos_profiles"), f"{file}, {topic['name']}"),
        type_hash=str(topic.get("type_description_hash") or ""),
        encoding=str(topic["serialization_format"]),
    )
