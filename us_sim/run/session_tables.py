"""Topics of a recording as pandas tables: a row for each message, in the order of recording.

Columns ``stamp`` (of the header; 0 where there is none), ``logged`` and ``sent`` are ns since the
epoch.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from us_sim import Progress
from us_sim.errors import BagError
from us_sim.recording.attached_files import new_file
from us_sim.recording.decoding import SECOND
from us_sim.recording.lerobot_writer import POSE_PARTS, TWIST_PARTS, WRENCH_PARTS
from us_sim.recording.path import POSE_STAMPED, list_bodies, read_pose_rows
from us_sim.recording.reader import Bag

WRENCH_STAMPED = "geometry_msgs/msg/WrenchStamped"
_TWIST_STAMPED = "geometry_msgs/msg/TwistStamped"
_LARGEST = 2**63 - 1
_COLUMNS = ("stamp", "logged", "sent", "number", "size", "is_short")


def read_times(
    bag: Bag,
    topics: Collection[str] | None = None,
    faults: list[str] | None = None,
    progress: Progress = lambda *_: None,
) -> dict[str, pd.DataFrame]:
    """Read when messages were stamped, sent and logged, their numbers and sizes, by topic.

    ``is_short`` is 1 for a message that ends before its stamp. Nothing else is decoded. Without
    ``topics`` all are read. ``faults`` takes what is wrong with the bag, all of which is read then.

    Raises:
        BagError: the bag is damaged, and ``faults`` is None; or it has no such topic.
    """
    chosen = bag.topics if topics is None else [bag.find_topic(name) for name in topics]
    readers = {topic.name: bag.make_stamp_reader(topic) for topic in chosen}
    values = {name: array("q") for name in readers}
    total = max(sum(topic.message_count for topic in chosen), 1)
    messages = bag.read_messages(topics) if faults is None else bag.read_all_messages(faults)
    for done, message in enumerate(messages):
        if done % 500 == 0:
            progress(min(done / total, 0.999), message.topic)
        read, stamp, is_short = readers[message.topic], 0, 0
        try:
            stamp = read(message.data) or 0 if read is not None else 0
        except (struct.error, IndexError):
            is_short = 1
        logged, sent = min(message.log_time, _LARGEST), min(message.publish_time, _LARGEST)
        row = (stamp, logged, sent, message.sequence, len(message.data), is_short)
        values[message.topic].extend(row)
    progress(1.0, "")
    return {
        name: pd.DataFrame(np.array(held, np.int64).reshape(-1, len(_COLUMNS)), columns=_COLUMNS)
        for name, held in values.items()
    }


def list_topics(bag: Bag, *types: str) -> list[str]:
    """List the topics of some types that have messages."""
    return [each.name for each in bag.topics if each.message_count and each.type_name in types]


def list_pose_sources(bag: Bag) -> list[str]:
    """List the topics of PoseStamped with messages, or else every body of other types."""
    bodies = [name for names in list_bodies(bag).values() for name in names]
    return list_topics(bag, POSE_STAMPED) or bodies


def _numbers(names: tuple[str, ...], linear: Any, angular: Any) -> dict[str, float]:
    values = (linear.x, linear.y, linear.z, angular.x, angular.y, angular.z)
    return dict(zip(names, map(float, values), strict=True))


VALUES: Mapping[str, Callable[[Any], dict[str, float]]] = {
    WRENCH_STAMPED: lambda m: _numbers(WRENCH_PARTS, m.wrench.force, m.wrench.torque),
    _TWIST_STAMPED: lambda m: _numbers(TWIST_PARTS, m.twist.linear, m.twist.angular),
    "sensor_msgs/msg/JointState": lambda m: dict(zip(m.name, m.position.tolist(), strict=False)),
}
"""The numbers in messages of these types, which are no poses."""


def read_values(bag: Bag, name: str) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Read poses, wrenches, twists or joint positions of a topic, or a body such as ``/tf:probe``.

    Returns:
        ``stamp``, ``logged`` and ``frame`` of each message, and its numbers in columns of their
        names: ``x`` and ``qw`` of a pose, ``fz`` of a wrench, or those of joints; NaN where a
        message lacks one.

    Raises:
        BagError: there is no such topic or body, it has no numbers, or a message is unlike ROS 2's.
    """
    topic = bag.find_topic(name.partition(":")[0])
    rows: list[tuple[int, int, str]] = []
    numbers: list[dict[str, float]] = []
    if topic.type_name in VALUES:
        for raw in bag.read_messages([topic.name]):
            message = bag.deserialize(raw)
            try:
                stamp = message.header.stamp.sec * SECOND + message.header.stamp.nanosec
                rows.append((stamp, raw.log_time, message.header.frame_id))
                numbers.append(VALUES[topic.type_name](message))
            except (AttributeError, TypeError, ValueError) as error:
                kind = f"no {topic.type_name} of ROS 2"
                raise BagError(f"{bag.path}, {topic.name}: {kind}: {error}") from None
    else:
        for row in read_pose_rows(bag, name):
            rows.append((row.stamp, row.log_time, row.frame_id))
            numbers.append(dict(zip(POSE_PARTS, row.pose, strict=True)))
    found = pd.DataFrame(rows, columns=["stamp", "logged", "frame"])
    return found, pd.DataFrame(numbers, index=found.index, dtype=float)


def read_wrenches(bag: Bag, name: str) -> tuple[str, pd.DataFrame]:
    """Read forces and torques, of a simulated probe or a sensor, in one frame.

    Returns:
        The frame, and ``stamp`` (ns) and the numbers (N and N m) of each message.

    Raises:
        BagError: there is no such topic, it is of another type, is silent, or its wrenches are of
            several frames.
    """
    topic = bag.find_topic(name)
    if topic.type_name != WRENCH_STAMPED:
        raise BagError(f"{bag.path} holds {topic.name} as {topic.type_name}, not {WRENCH_STAMPED}")
    found, table = read_values(bag, topic.name)
    frames = found["frame"].unique()
    if len(frames) != 1:
        held = f"wrenches in the frames {', '.join(frames)}" if len(frames) else "no wrench"
        raise BagError(f"{bag.path} holds {held} on {topic.name}: a sensor has one frame")
    return str(frames[0]), table.assign(stamp=found["stamp"])


def write_table(file: Path, table: pd.DataFrame, **options: Any) -> Path:
    """Write a table as a new CSV file, with ``options`` of pandas; return its path.

    Raises:
        BagError: the file is there already, or cannot be written.
    """
    with new_file(file) as stream:
        table.to_csv(stream, mode="wb", index=False, lineterminator="\n", **options)
    return file
