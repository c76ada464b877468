"""A probe's path: the poses of one body in a bag or a tracker recording, as arrays.

A body is named ``TOPIC`` where its messages hold one pose, ``TOPIC:NUMBER`` in a PoseArray,
``TOPIC:FRAME`` in tf, and ``TOPIC:FRAME:PARENT`` for a frame in another one further up.

>>> import numpy as np, tempfile
>>> from us_sim.recording.path import ProbePath, read_path, write_path
>>> stamps = 1_700_000_000_000_000_000 + np.array([0, 16_666_667])
>>> positions = np.array([[0, 0, -0.01], [0, 0, -0.009]])
>>> orientations = np.array([[0, 0, 0, 1.0], [0, 0, 0, 1.0]])
>>> file = tempfile.mkdtemp() + "/path.mcap"
>>> write_path(file, ProbePath("/tracker/pose", "patient", stamps, positions, orientations))
>>> read_path(file).positions[:, 2]
array([-0.01 , -0.009])
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import BagError, TrackingError
from us_sim.recording.probe_path import ProbePath
from us_sim.recording.reader import Bag, read_bag
from us_sim.recording.resampling import Times, slerp
from us_sim.recording.schemas import jazzy_definitions, stamped
from us_sim.recording.storage import NoBagError
from us_sim.recording.topic import BagTopic, QosProfile
from us_sim.recording.writer import BagWriter
from us_sim.volume.sequences.itk_transform import TRANSFORM_SUFFIXES
from us_sim.volume.sequences.sequence import SEQUENCE_SUFFIXES

POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
_POSE_ARRAY = "geometry_msgs/msg/PoseArray"
_TF = "tf2_msgs/msg/TFMessage"
_NOWHERE = (math.nan,) * 7
_LATE = 1_000_000_000  # ns that a stamp may be older than one before; more is another time
_LONGEST_GAP = 10_000_000_000  # ns between two transforms that belong together, as tf2 keeps them

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

    The leading slash of its name may be left away.

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
                yield Row(raw.log_time, stamp, header.frame_id, pose), found
        except (AttributeError, TypeError) as error:  # the bag's own definitions are damaged
            raise BagError(f"{bag.path}: no {topic.type_name} of ROS 2: {error}") from None


def _chained(bag: Bag, topic: BagTopic, body: str, parent: str) -> Iterator[Row]:
    """The poses of a frame of tf in one further up, all links of the way at one time.

    They are made at the stamps of the link that moves least often, and the others interpolated
    there; without a pose where one of them is not known then.
    """
    from scipy.spatial.transform import Rotation

    links: dict[str, list[Row]] = {}
    fixed: set[str] = set()
    static = f"{topic.name}_static"
    if any(each.name == static for each in bag.topics):
        for row, (frame, *_) in _each(bag, bag.topic(static)):
            links[frame] = [row]
            fixed.add(frame)
    for row, (frame, *_) in _each(bag, topic):
        links[frame] = [row] if frame in fixed or frame not in links else [*links[frame], row]
        fixed.discard(frame)
    way: list[str] = []
    while (frame := links[way[-1]][0].frame_id.lstrip("/") if way else body) != parent:
        if frame not in links or frame in way:
            way = []
            break
        way.append(frame)
    moving = [frame for frame in way if frame not in fixed]
    if not moving:
        raise BagError(
            f"{bag.path} holds no way in {topic.name} from '{body}' up to '{parent}' that moves"
        )
    tracks = {frame: _track(bag, frame, links[frame]) for frame in way}
    slowest = min(moving, key=lambda frame: len(links[frame]))
    stamps = np.unique([row.stamp for row in links[slowest]])
    turn, place = Rotation.identity(len(stamps)), np.zeros((len(stamps), 3))
    for frame in way:
        poses = _at(tracks[frame], stamps, is_fixed=frame in fixed)
        is_known = np.isfinite(poses).all(axis=1)
        place[~is_known] = np.nan
        poses[~is_known] = 0, 0, 0, 0, 0, 0, 1
        link = Rotation.from_quat(poses[:, 3:])
        turn, place = link * turn, link.apply(place) + poses[:, :3]
    base = stamps[0]
    seen = np.array([(row.stamp - base, row.log_time - base) for row in links[moving[0]]])
    seen = seen[np.argsort(seen[:, 0], kind="stable")]
    times = np.interp(stamps - base, *seen.T).round().astype(np.int64) + base
    for time, stamp, at, q in zip(times, stamps, place, turn.as_quat(), strict=True):
        pose = (*at.tolist(), *q.tolist()) if np.isfinite(at).all() else _NOWHERE
        yield Row(int(time), int(stamp), parent, pose)


def _track(bag: Bag, frame: str, rows: list[Row]) -> tuple[Times, NDArray[np.float64]]:
    """The poses (K, 7) of a frame of tf by its stamps, each stamp once."""
    if len({row.frame_id for row in rows}) > 1:
        raise BagError(f"{bag.path} holds '{frame}' of tf in several frames: no way up is known")
    stamps = np.array([row.stamp for row in rows], np.int64)
    back = (np.maximum.accumulate(stamps) - stamps).max()
    if back > _LATE:
        raise BagError(
            f"{bag.path}: stamps of '{frame}' in tf go back by {back / 1e9:.1f} s, so nobody knows "
            f"which transforms go together: cut the recording there"
        )
    stamps, first = np.unique(stamps, return_index=True)
    return stamps, np.array([row.pose for row in rows])[first]


def _at(track: tuple[Times, NDArray[np.float64]], stamps: Times, *, is_fixed: bool) -> Any:
    """Poses (M, 7) of a link at stamps; nan where there is none, or a neighbour is far."""
    times, poses = track
    usable = is_pose(poses)
    if is_fixed:
        return np.tile(poses[0] if usable[0] else _NOWHERE, (len(stamps), 1))
    found = np.full((len(stamps), 7), np.nan)
    after = np.clip(np.searchsorted(times, stamps), 0, len(times) - 1)
    before = np.clip(np.searchsorted(times, stamps, side="right") - 1, 0, None)
    known = (times[before] <= stamps) & (stamps <= times[after])
    known &= usable[before] & usable[after] & (times[after] - times[before] <= _LONGEST_GAP)
    if usable.sum() > 1 and known.any():
        found[known] = slerp(times[usable], poses[usable], stamps[known])
    elif known.any():
        found[known] = poses[usable]
    return found


_PATHS = "give a bag (.mcap, .db3) or a tracker recording of PLUS (.igs.mha, .igs.nrrd)"
_MOST_NAMES = 20  # bodies that are listed where one has to be named


def read_path(path: str | Path, topic: str | None = None, *, option: str = "topic") -> ProbePath:
    """Reads the poses of a bag, or of a tracker recording of Plus (``.mha``, ``.nrrd``).

    Poses that are not finite or have no orientation are left out and counted.

    Args:
        path: any bag that ``read_bag`` reads, or a recording.
        topic: of the bag, or a body's name as above (``/tf:probe``); by default the bag's only
            PoseStamped topic, among several the one named ``tracker/pose`` (where its poses are of
            several frames, ``probe/pose``), and without any the only body of other types. In a
            recording, a transform (``ProbeToReference``).
        option: the option that names the topic, for the sentence on several.

    Raises:
        BagError: there is no such bag or topic, several come into question, the topic is of
            another type or encoding, its poses are of several frames, or none is usable.
        TrackingError: the same of a recording.
    """
    if is_tracker_recording(path):
        from us_sim.recording.plus_recording import read_tracker_recording

        recording = read_tracker_recording(path)
        if topic is None and len(recording.transforms) > 1:
            names = ", ".join(recording.transforms)
            raise TrackingError(f"{path}: has several transforms: name one by {option}, of {names}")
        return recording.probe_path(topic)
    try:
        bag = read_bag(path)
    except NoBagError as error:
        single = Path(path).suffix.lower() in TRANSFORM_SUFFIXES
        remedy = "a single transform belongs in `registration` or `calibration`; " if single else ""
        raise BagError(f"{error}; {remedy}{_PATHS}") from None
    read = _read(bag, topic or _only_body(bag, option))
    if topic is None and len(read.frames) > 1:  # a hand and a device took turns
        poses = [each.name for each in bag.topics if each.type_name == POSE_STAMPED]
        of_probe = [name for name in poses if name.endswith("/probe/pose") and name != read.name]
        read = _read(bag, of_probe[0]) if len(of_probe) == 1 else read
    return _usable(bag, read)


def is_tracker_recording(path: str | Path) -> bool:
    """Whether a file's name is that of a sequence of Plus or 3D Slicer."""
    return Path(path).suffix.lower() in SEQUENCE_SUFFIXES


def write_path(file: str | Path, path: ProbePath, *, sidecar: bool = True) -> None:
    """Writes a path as a bag of its one topic, compressed; ``sidecar`` is as for `BagWriter`.

    Raises:
        BagError: the file exists or cannot be written.
    """
    with BagWriter(file, compression="zstd", sidecar=sidecar) as writer:
        write_poses(writer, path)


def write_poses(writer: BagWriter, path: ProbePath) -> None:
    """Writes a path into a bag that is open, as one of its topics: reliable, keep last 10.

    Raises:
        BagError: it cannot be written.
    """
    writer.add_topic(path.topic, POSE_STAMPED, [QosProfile()])
    types = jazzy_definitions().types
    rows = zip(path.stamps, path.log_times, path.positions, path.orientations, strict=True)
    for stamp, log_time, position, orientation in rows:
        pose = types["geometry_msgs/msg/Pose"](
            position=types["geometry_msgs/msg/Point"](*position.tolist()),
            orientation=types["geometry_msgs/msg/Quaternion"](*orientation.tolist()),
        )
        message = stamped(POSE_STAMPED, int(stamp), path.frame_id, pose=pose)
        writer.write(path.topic, message, int(log_time), int(stamp))


def _only_body(bag: Bag, option: str) -> str:
    """The bag's only topic of PoseStamped, a session's tracker poses, or the only other body."""
    stamped = [topic.name for topic in bag.topics if topic.type_name == POSE_STAMPED]
    tracked = [name for name in stamped if name.endswith("/tracker/pose")]
    others = [] if stamped else [name for names in bodies_in(bag).values() for name in names]
    for candidates in (stamped, tracked, others):
        if len(candidates) == 1:
            return candidates[0]
    names = sorted(stamped or others)
    if names:
        more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
        raise BagError(
            f"{bag.path} holds poses of several bodies: name one by {option}, of "
            f"{', '.join(names[:_MOST_NAMES])}{more}"
        )
    found = ", ".join(sorted(f"{topic.name} ({topic.type_name})" for topic in bag.topics))
    raise BagError(
        f"{bag.path} holds no topic of {POSE_STAMPED}, nor of other poses; it has "
        f"{found or 'no topic'}"
    )


def is_pose(poses: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(K,) whether each of (K, 7) is finite and has an orientation, as `Pose` asks for.

    Trackers send a zero quaternion for a lost marker.
    """
    with np.errstate(invalid="ignore"):
        has_orientation = np.linalg.norm(poses[:, 3:], axis=1) >= 1e-6
    return np.isfinite(poses).all(axis=1) & has_orientation


@dataclass(frozen=True, eq=False)
class _Read:
    """All recorded poses of a body."""

    name: str
    frames: tuple[str, ...]  # in which they are
    times: NDArray[np.int64]  # (K, 2) ns: log time and stamp
    poses: NDArray[np.float64]  # (K, 7)


def _read(bag: Bag, name: str) -> _Read:
    topic, colon, body = name.partition(":")
    name = bag.topic(topic).name + colon + body
    rows = list(pose_rows(bag, name))
    times = np.array([(row.log_time, row.stamp) for row in rows], np.int64)
    return _Read(
        name,
        tuple(dict.fromkeys(row.frame_id for row in rows)),
        times.reshape(-1, 2),
        np.array([row.pose for row in rows], np.float64).reshape(-1, 7),
    )


def _usable(bag: Bag, read: _Read) -> ProbePath:
    """The poses of one frame that can be used."""
    count, poses = len(read.poses), read.poses
    if not count:
        raise BagError(f"{bag.path} holds no pose on {read.name}; {bag.note or 'it is silent'}")
    if len(read.frames) > 1:
        raise BagError(
            f"{bag.path} holds poses on {read.name} in the frames {', '.join(read.frames)}: a path "
            f"has one frame"
        )
    usable = is_pose(poses)
    rejected = count - int(usable.sum())
    notes = [bag.note] if bag.note else []
    if rejected:
        notes.append(
            f"{rejected} of the {count} poses on {read.name} are not finite"
            + (", or not known all the way up," if read.name.count(":") > 1 else "")
            + " or have no orientation and are left out, the first being number "
            + str(int(np.argmin(usable)) + 1)
        )
    if rejected == count:
        raise BagError(f"{bag.path} holds no usable pose: {'; '.join(notes)}")
    return ProbePath(
        topic=read.name,
        frame_id=read.frames[0],
        stamps=read.times[usable, 1],
        positions=poses[usable, :3],
        orientations=poses[usable, 3:],
        log_times=read.times[usable, 0],
        rejected=rejected,
        note="; ".join(notes),
    )
