"""The ``metadata.yaml`` of a bag, which `ros2 bag` needs, as ROS 2 Jazzy writes it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from rosbags.rosbag2.metadata import dump_qos_v9

from us_sim.recording.topic import BagTopic
from us_sim.settings.text_files import YamlError, load_yaml

METADATA, INFORMATION = "metadata.yaml", "rosbag2_bagfile_information"  # the file, and its key
NO_TIME = 2**63 - 1  # ns, the starting time that rosbag2 gives a bag without messages


def bag_information(
    file: str, topics: Sequence[BagTopic], start: int, duration: int
) -> dict[str, Any]:
    """Return what rosbag2 says of a bag of one MCAP file: in ``metadata.yaml`` and in the file.

    Args:
        file: its name.
        topics: with the numbers of their messages.
        start: lowest log time, ns since the epoch; `NO_TIME` where there are no messages.
        duration: from there to the highest, ns.
    """
    extent = {
        "starting_time": {"nanoseconds_since_epoch": start},
        "duration": {"nanoseconds": duration},
        "message_count": sum(topic.message_count for topic in topics),
    }
    return {
        "version": 9,
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
            for topic in topics
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file],
        "files": [{"path": file, **extent}],
        "custom_data": None,
        "ros_distro": os.environ.get("ROS_DISTRO") or "jazzy",
    }


def missing_files(folder: Path) -> list[str]:
    """Return the names of files that a bag's ``metadata.yaml`` lists and its folder lacks.

    There are none where there is no such file, or it is another one.
    """
    try:
        text = (folder / METADATA).read_text(encoding="utf-8")
        listed = load_yaml(text)[INFORMATION]["relative_file_paths"]
        names = [PurePosixPath(each).name.removesuffix(".zstd") for each in listed]
    except (OSError, YamlError, LookupError, TypeError, UnicodeError):
        return []
    return [name for name in names if not (folder / name).is_file()]
