"""The poses of one body in the messages of a bag, whatever type they have.

A body is named ``TOPIC`` where its messages hold one pose, ``TOPIC:NUMBER`` in a PoseArray,
``TOPIC:FRAME`` in tf, and ``TOPIC:FRAME:PARENT`` for a frame in another one further up.

>>> import tempfile
>>> from us_sim.recording.press_and_slide import press_and_slide
>>> from us_sim.recording.path import write_path
>>> from us_sim.recording.reader import read_bag
>>> from us_sim.recording.recorded_poses import pose_rows
>>> file = tempfile.mkdtemp() + "/path.mcap"
>>> write_path(file, press_and_slide())
>>> row = next(pose_rows(read_bag(file), "/tracker/pose"))
>>> row.frame_id, len(row.pose)
('patient', 7)
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from us_sim.errors import BagError, PoseError
from us_sim.geometry.pose import FrameTree, Pose
from us_sim.recording.reader import Bag
from us_sim.recording.topic import BagTopic

POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
_POSE_ARRAY = "geometry_msgs/msg/PoseArray"
_TF = "tf2_msgs/msg/TFMessage"
_NOWHERE = (math.nan,) * 7

_Found = tuple[str, Any, Any, Any]  # a body's name, header, position, orientation


def _within(message: Any) -> list[_Found]:
    return [("", message.header, message.pose.pose.position, message.pose.pose.orientation)]


def _transform(message: Any, body: str = "") -> _Found:
    return body, message.header, message.transform.translation, message.transform.rotation


_POSES: Mapping[str, Callable[[Any], list[_Found]]] = {
    POSE_STAMPED: lambda m: [("", m.header, m.pose.position, m.pose.orientation)],
    "geometry_msgs/msg/PoseWithCovarianceStamped": _within,
    "nav_msgs/msg/Odometry": _within,
    "geometry_msgs/msg/TransformStamped": lambda m: [_transform(m)],
    _POSE_ARRAY: lambda m: [
        (str(k), m.header, pose.position, pose.orientation) for k, pose in enumerate(m.poses)
    ],
    _TF: lambda m: [_transform(each, each.child_frame_id.lstrip("/")) for each in m.transforms],
}


class Row(NamedTuple):
    """One recorded pose, as it was recorded."""

    log_time: int  # ns since the epoch
    stamp: int  # ns since the epoch, of the header
    frame_id: str
    pose: tuple[float, ...]  # x, y, z (m), quaternion x, y, z, w; nan where there is none


def bodies_in(bag: Bag) -> dict[str, list[str]]:
    """Names of the bodies whose poses a bag holds, by the types of their messages.

    Raises:
        BagError: a message cannot be read.
    """
    found: dict[str, list[str]] = {}
    for topic in bag.topics:
        if topic.type_name not in _POSES or topic.name.endswith("tf_static"):
            continue
        names = {topic.name: None}
        if topic.type_name in (_POSE_ARRAY, _TF):
            names = {f"{topic.name}:{each[0]}": None for _, each in _each(bag, topic)}
        found.setdefault(topic.type_name, []).extend(names)
    return found


def pose_rows(bag: Bag, name: str) -> Iterator[Row]:
    """The poses of a body, in the order in which they were recorded.

    Args:
        bag: that holds them.
        name: of the body. The leading slash may be left away.

    Raises:
        BagError: the bag has no such topic or body, or one of a type without poses.
    """
    topic_name, _, body = name.partition(":")
    topic = bag.topic(topic_name)
    if topic.type_name not in _POSES:
        raise BagError(
            f"{bag.path} holds {topic.name} as {topic.type_name}: a path needs one of "
            f"{', '.join(_POSES)}"
        )
    body, _, parent = body.partition(":")
    if parent:
        yield from _chained(bag, topic, body, parent)
        return
    found: dict[str, None] = {}
    for row, (other, *_) in _each(bag, topic):
        found[other] = None
        if other == body:
            yield row
    if found and body not in found:
        names = ", ".join(f"{topic.name}:{each}" if each else topic.name for each in found)
        raise BagError(f"{bag.path} has no {name}; it has {names}")


def _each(bag: Bag, topic: BagTopic) -> Iterator[tuple[Row, _Found]]:
    """Every pose of a topic's messages, with the body that it is of."""
    poses = _POSES[topic.type_name]
    for raw in bag.messages([topic.name]):
        message = bag.deserialize(raw)
        try:
            for found in poses(message):
                _, header, p, q = found
                stamp = header.stamp.sec * 10**9 + header.stamp.nanosec
                pose = (p.x, p.y, p.z, q.x, q.y, q.z, q.w)
                yield Row(raw.log_time, stamp, header.frame_id, tuple(map(float, pose))), found
        except (AttributeError, TypeError, ValueError, OverflowError) as error:
            raise BagError(
                f"{bag.path} defines or times {topic.type_name} as ROS 2 does not, so that there "
                f"are no poses on {topic.name}: {error}"
            ) from None


def _chained(bag: Bag, topic: BagTopic, body: str, parent: str) -> Iterator[Row]:
    """The poses of a frame of tf in one further up, each time that a frame between moves.

    Frames between are taken where they last were, as the tracker source ``tf`` does.
    """
    tree = FrameTree()
    static = f"{topic.name}_static"
    if any(each.name == static for each in bag.topics):
        for row, (frame, *_) in _each(bag, bag.topic(static)):
            with contextlib.suppress(PoseError):  # a way through it is then none
                tree.place(frame, row.frame_id.lstrip("/"), _pose(row))
    is_there = False
    for row, (frame, *_) in _each(bag, topic):
        try:
            tree.place(frame, row.frame_id.lstrip("/"), _pose(row))
        except PoseError:
            yield row._replace(frame_id=parent, pose=_NOWHERE)
            continue
        chain = tree.chain(body, parent)
        if chain is not None and frame in chain:
            is_there = True
            pose = tree.pose(chain)
            values = tuple(map(float, (*pose.position, *pose.orientation)))
            yield Row(row.log_time, row.stamp, parent, values)
    if not is_there:
        raise BagError(
            f"{bag.path} holds no way in {topic.name} from '{body}' up to '{parent}' that moves"
        )


def _pose(row: Row) -> Pose:
    return Pose(np.array(row.pose[:3]), np.array(row.pose[3:]))
