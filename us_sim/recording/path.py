"""A probe's path: the poses of one body in a bag or a tracker recording, as arrays.

A body is named ``TOPIC`` where its messages hold one pose, ``TOPIC:NUMBER`` in a PoseArray,
``TOPIC:FRAME`` in tf, and ``TOPIC:FRAME:PARENT`` for a frame in another one further up.

Tracker recordings are sequence files of Plus (`.igs.mha`, `.igs.nrrd`), with or without images:
every sample has a time and named transforms (``ProbeToTracker``), each with a status.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import BagError, TrackingError, VolumeError
from us_sim.geometry.frame_chain import FrameChain
from us_sim.geometry.pose import Pose
from us_sim.recording.reader import Bag, read_bag
from us_sim.recording.schemas import load_jazzy_definitions, serialize_stamped
from us_sim.recording.topic import DEFAULT_QOS, BagTopic
from us_sim.recording.writer import BagWriter
from us_sim.volume.sequences.sequence import SEQUENCE_SUFFIXES, read_sequence
from us_sim.volume.sequences.transforms import (
    FrameTransforms,
    find_shortest_chain,
    is_image_frame,
    multiply_chain,
    split_transform_name,
)

POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
_POSE_ARRAY = "geometry_msgs/msg/PoseArray"
_TF = "tf2_msgs/msg/TFMessage"
_RIGID = 5e-3  # how far from 1 a rotation may scale; real trackers round to 3e-4


@dataclass(frozen=True, eq=False)
class ProbePath:
    """Poses in the order in which they were recorded; their stamps may go back.

    Examples:
        >>> stamps = 1_700_000_000_000_000_000 + np.array([0, 500_000_000])
        >>> upright = np.eye(4)[[3, 3]]
        >>> path = ProbePath("/tracker/pose", "patient", stamps, np.zeros((2, 3)), upright)
        >>> len(path), path.duration
        (2, 0.5)
    """

    topic: str
    frame_id: str
    stamps: NDArray[np.int64]  # (K,) ns since the epoch, of the messages' headers
    positions: NDArray[np.float64]  # (K, 3) m, frame frame_id
    orientations: NDArray[np.float64]  # (K, 4) x, y, z, w as recorded, not normalised
    log_times: NDArray[np.int64] = field(  # (K,) ns since the epoch; the stamps by default
        default_factory=lambda: np.empty(0, np.int64)
    )
    rejected: int = 0  # poses of the topic left out: not finite, or without an orientation
    note: str = ""  # the recording's faults, in a sentence; empty when there are none

    def __post_init__(self) -> None:
        if not len(self.log_times):
            object.__setattr__(self, "log_times", self.stamps)

    def __len__(self) -> int:
        return len(self.stamps)

    def pose_at(self, index: int) -> Pose:
        """Return the pose at a place in the path, its quaternion normalised."""
        return Pose(self.positions[index], self.orientations[index])

    @property
    def poses(self) -> list[Pose]:
        """Return all poses, as `pose_at` returns them."""
        return [self.pose_at(index) for index in range(len(self))]

    @property
    def duration(self) -> float:
        """Return the seconds from the first to the last recorded pose."""
        return float(self.log_times[-1] - self.log_times[0]) / 1e9 if len(self) else 0.0


class RecordedPose(NamedTuple):
    """One recorded pose, as it was recorded."""

    log_time: int  # ns since the epoch
    stamp: int  # ns since the epoch, of the header
    frame_id: str
    pose: tuple[float, ...]  # x, y, z (m), quaternion x, y, z, w; nan where there is none


_Found = tuple[str, Any, Any, Any]  # a body's name, header, position, orientation


def _single(header: Any, pose: Any) -> list[_Found]:
    return [("", header, pose.position, pose.orientation)]


def _transform(message: Any, body: str = "") -> _Found:
    return body, message.header, message.transform.translation, message.transform.rotation


_POSES: Mapping[str, Callable[[Any], list[_Found]]] = {
    POSE_STAMPED: lambda m: _single(m.header, m.pose),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda m: _single(m.header, m.pose.pose),
    "nav_msgs/msg/Odometry": lambda m: _single(m.header, m.pose.pose),
    "geometry_msgs/msg/TransformStamped": lambda m: [_transform(m)],
    _POSE_ARRAY: lambda m: [
        (str(k), m.header, pose.position, pose.orientation) for k, pose in enumerate(m.poses)
    ],
    _TF: lambda m: [_transform(each, each.child_frame_id.lstrip("/")) for each in m.transforms],
}


def list_bodies(bag: Bag) -> dict[str, list[str]]:
    """Return the names of the bodies whose poses a bag holds, by the types of their messages.

    Raises:
        BagError: a message cannot be read.
    """
    found: dict[str, list[str]] = {}
    for topic in bag.topics:
        if topic.type_name not in _POSES or topic.name.endswith("tf_static"):
            continue
        names = {topic.name: None}
        if topic.type_name in (_POSE_ARRAY, _TF):
            names = {f"{topic.name}:{body}": None for body, _ in _iter_poses(bag, topic)}
        found.setdefault(topic.type_name, []).extend(names)
    return found


def read_pose_rows(bag: Bag, name: str) -> Iterator[RecordedPose]:
    """Yield the poses of a body, in the order in which they were recorded.

    The leading slash of its name may be left away.

    Raises:
        BagError: the bag has no such topic or body, or one of a type without poses.
    """
    topic_name, _, body = name.partition(":")
    topic = bag.find_topic(topic_name)
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
    for other, row in _iter_poses(bag, topic):
        found[other] = None
        if other == body:
            yield row
    if found and body not in found:
        names = ", ".join(f"{topic.name}:{each}" if each else topic.name for each in found)
        raise BagError(f"{bag.path} has no {name}; it has {names}")


def _iter_poses(bag: Bag, topic: BagTopic) -> Iterator[tuple[str, RecordedPose]]:
    """Yield every pose of a topic's messages, after the body that it is of."""
    poses = _POSES[topic.type_name]
    for raw in bag.read_messages([topic.name]):
        message = bag.deserialize(raw)
        try:
            for body, header, p, q in poses(message):
                stamp = header.stamp.sec * 10**9 + header.stamp.nanosec
                pose = (p.x, p.y, p.z, q.x, q.y, q.z, q.w)
                yield body, RecordedPose(raw.log_time, stamp, header.frame_id, pose)
        except (AttributeError, TypeError) as error:  # the bag's own definitions are damaged
            raise BagError(f"{bag.path}: no {topic.type_name} of ROS 2: {error}") from None


def _chained(bag: Bag, topic: BagTopic, body: str, parent: str) -> Iterator[RecordedPose]:
    """Yield the poses of a frame of tf in one further up, as `FrameChain` makes them live."""
    chain, is_empty = FrameChain(body, parent), True
    static = f"{topic.name}_static"
    for name in [each.name for each in bag.topics if each.name == static] + [topic.name]:
        for frame, row in _iter_poses(bag, bag.find_topic(name)):
            numbers = np.array(row.pose)
            if not are_poses(numbers[None])[0]:
                continue
            above, pose = row.frame_id.lstrip("/"), Pose(numbers[:3], numbers[3:])
            if name == static:
                chain.set_fixed_link(frame, above, pose)
            elif made := chain.update_link(frame, above, row.stamp, pose):
                stamp, found = made
                is_empty = False
                yield RecordedPose(
                    row.log_time, stamp, parent, (*found.position, *found.orientation)
                )
    if is_empty:
        raise BagError(
            f"{bag.path} holds no way in {topic.name} from '{body}' up to '{parent}' that moves"
        )


_MOST_NAMES = 20  # bodies that are listed where one has to be named


def read_path(path: str | Path, topic: str | None = None, *, option: str = "topic") -> ProbePath:
    """Read the poses of a bag, or of a tracker recording of Plus (``.mha``, ``.nrrd``).

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

    Examples:
        >>> path = read_path("bags/press_and_slide.mcap")
        >>> len(path), round(float(path.positions[:, 2].max()), 3)  # m, into the tissue
        (600, 0.012)
    """
    if is_tracker_recording(path):
        return read_tracker_recording(path).make_probe_path(topic, option=option)
    bag = read_bag(path)
    name = find_whole_name(bag, topic or _only_body(bag, option))
    rows = list(read_pose_rows(bag, name))
    if topic is None and len(_frames(rows)) > 1:  # a hand and a device took turns
        poses = [each.name for each in bag.topics if each.type_name == POSE_STAMPED]
        of_probe = [each for each in poses if each.endswith("/probe/pose") and each != name]
        if len(of_probe) == 1:
            name, rows = of_probe[0], list(read_pose_rows(bag, of_probe[0]))
    return _make_path(bag, name, rows)


def is_tracker_recording(path: str | Path) -> bool:
    """Return whether a file's name is that of a sequence of Plus or 3D Slicer."""
    return Path(path).suffix.lower() in SEQUENCE_SUFFIXES


def write_path(file: str | Path, path: ProbePath, *, sidecar: bool = True) -> None:
    """Write a path as a bag of its one topic, compressed; ``sidecar`` is as for `BagWriter`.

    Raises:
        BagError: the file exists or cannot be written.

    Examples:
        >>> import numpy as np, tempfile
        >>> stamps = 1_700_000_000_000_000_000 + np.array([0, 16_666_667])
        >>> positions = np.array([[0, 0, -0.01], [0, 0, -0.009]])
        >>> orientations = np.array([[0, 0, 0, 1.0], [0, 0, 0, 1.0]])
        >>> file = tempfile.mkdtemp() + "/path.mcap"
        >>> write_path(file, ProbePath("/tracker/pose", "patient", stamps, positions, orientations))
        >>> read_path(file).positions[:, 2]
        array([-0.01 , -0.009])
    """
    with BagWriter(file, compression="zstd", sidecar=sidecar) as writer:
        write_poses(writer, path)


def write_poses(writer: BagWriter, path: ProbePath) -> None:
    """Write a path into a bag that is open, as one of its topics: reliable, keep last 10.

    Raises:
        BagError: it cannot be written.
    """
    writer.add_topic(path.topic, POSE_STAMPED, [DEFAULT_QOS])
    types = load_jazzy_definitions().types
    rows = zip(path.stamps, path.log_times, path.positions, path.orientations, strict=True)
    for stamp, log_time, position, orientation in rows:
        pose = types["geometry_msgs/msg/Pose"](
            position=types["geometry_msgs/msg/Point"](*position.tolist()),
            orientation=types["geometry_msgs/msg/Quaternion"](*orientation.tolist()),
        )
        message = serialize_stamped(POSE_STAMPED, int(stamp), path.frame_id, pose=pose)
        writer.write_message(path.topic, message, int(log_time), int(stamp))


def _only_body(bag: Bag, option: str) -> str:
    """Return the only topic of PoseStamped, a session's tracker poses, or the only other body."""
    stamped = [topic.name for topic in bag.topics if topic.type_name == POSE_STAMPED]
    tracked = [name for name in stamped if name.endswith("/tracker/pose")]
    others = [] if stamped else [name for names in list_bodies(bag).values() for name in names]
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


def are_poses(poses: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return (K,) whether each of (K, 7) is finite and has an orientation, as `Pose` asks for.

    Trackers send a zero quaternion for a lost marker.
    """
    with np.errstate(invalid="ignore"):
        has_orientation = np.linalg.norm(poses[:, 3:], axis=1) >= 1e-6
    return np.isfinite(poses).all(axis=1) & has_orientation


def find_whole_name(bag: Bag, name: str) -> str:
    """Return a topic's or body's name with its leading slash, where the bag has one."""
    topic, colon, body = name.partition(":")
    return bag.find_topic(topic).name + colon + body


def _frames(rows: list[RecordedPose]) -> list[str]:
    return list(dict.fromkeys(row.frame_id for row in rows))


def _make_path(bag: Bag, name: str, rows: list[RecordedPose]) -> ProbePath:
    """Return the poses of one frame that can be used."""
    if not rows:
        raise BagError(f"{bag.path} holds no pose on {name}; {bag.fault or 'it is silent'}")
    frames = _frames(rows)
    if len(frames) > 1:
        raise BagError(
            f"{bag.path} holds poses on {name} in the frames {', '.join(frames)}: a path has one "
            f"frame"
        )
    poses = np.array([row.pose for row in rows], np.float64)
    usable = are_poses(poses)
    rejected = len(rows) - int(usable.sum())
    notes = [bag.fault] if bag.fault else []
    if rejected:
        notes.append(
            f"{rejected} of the {len(rows)} poses on {name} are not finite or have no orientation "
            f"and are left out, the first being number {int(np.argmin(usable)) + 1}"
        )
    if rejected == len(rows):
        raise BagError(f"{bag.path} holds no usable pose: {'; '.join(notes)}")
    times = np.array([(row.log_time, row.stamp) for row in rows], np.int64)[usable]
    return ProbePath(
        topic=name,
        frame_id=frames[0],
        stamps=times[:, 1],
        positions=poses[usable, :3],
        orientations=poses[usable, 3:],
        log_times=times[:, 0],
        rejected=rejected,
        note="; ".join(notes),
    )


@dataclass(frozen=True, eq=False)
class TrackerRecording:
    """Rigid transforms over time; a transform ``AToB`` takes points of A to B."""

    path: Path
    times: NDArray[np.float64]  # (K,) s, the recorder's clock, as they were recorded
    transforms: Mapping[str, FrameTransforms]  # by name
    untimed: int  # samples of the file without a time, none of whose transforms is used

    def __len__(self) -> int:
        return len(self.times)

    def count_left_out(self, name: str) -> dict[str, int]:
        """Count the samples of a transform that are not valid, by reason."""
        return dict(Counter(fault for fault in self.transforms[name].faults if fault))

    def make_probe_path(self, name: str | None = None, option: str = "topic") -> ProbePath:
        """Return the valid poses of a body as a path, by the recorder's clock.

        Args:
            name: of a transform (``StylusToTracker``), also one that others make up
                (``StylusToReference``), or of a body (``Stylus``), whose own transform is meant;
                None is the recording's only transform.
            option: what names it, for the sentence on several.

        Raises:
            TrackingError: the recording has no such transform, the name is missing, or no pose is
                valid.
        """
        names = ", ".join(self.transforms)
        if name is None:
            if len(self.transforms) != 1:
                raise TrackingError(
                    f"{self.path}: has several transforms: name one by {option}, of {names}"
                )
            (name,) = self.transforms
        body, end = split_transform_name(name) or (name, None)
        frames = filter(None, map(split_transform_name, self.transforms))
        ends = [end] if end else [top for start, top in frames if start == body]
        chain = find_shortest_chain(self.transforms, body, ends[0]) if len(ends) == 1 else None
        if chain is None:
            raise TrackingError(
                f"{self.path}: no transform or several lead from {name} to {end or 'a frame'}; its "
                f"transforms are {names}"
            )
        found = multiply_chain(self.transforms, chain)
        valid = found.valid
        why = self.explain_gaps(key for key, _ in chain.steps)
        if not valid.any():
            raise TrackingError(
                f"{self.path}: none of the {len(self)} poses of {name} is valid{why}"
            )
        poses = [Pose.from_matrix(matrix) for matrix in found.matrices[valid]]
        rejected = self.untimed + int((~valid).sum())
        count = self.untimed + len(self)
        return ProbePath(
            topic=name,
            frame_id=chain.reference,
            stamps=np.round(self.times[valid] * 1e9).astype(np.int64),
            positions=np.array([pose.position for pose in poses]),
            orientations=np.array([pose.orientation for pose in poses]),
            rejected=rejected,
            note=f"{rejected} of the {count} poses of {name} are left out{why}" if rejected else "",
        )

    def explain_gaps(self, names: Iterable[str]) -> str:
        """Say in brackets which samples of these transforms were left out; nothing if none were."""
        said = [
            f"{count} with {reason}"
            for name in names
            for reason, count in self.count_left_out(name).items()
        ]
        if self.untimed:
            said.append(f"{self.untimed} without a time")
        return f" ({', '.join(said)})" if said else ""


def read_tracker_recording(path: str | Path) -> TrackerRecording:
    """Read the transforms of a sequence file of Plus.

    A transform whose status is not OK, or that is not rigid (Plus writes zeros for a tool
    that it has not seen), is not valid; a sample without a time is left out whole. Both are
    counted.

    Raises:
        TrackingError: the file is missing, is no sequence, is cut, or holds no transform or none
            that is valid.
    """
    path = Path(path)
    try:
        sequence = read_sequence(path)
    except VolumeError as error:
        raise TrackingError(str(error)) from error
    times = sequence.times
    timed = np.flatnonzero(np.isfinite(times))
    transforms = {
        name: _rigid(series, timed)
        for name, series in sequence.transforms.items()
        if not any(map(is_image_frame, split_transform_name(name) or ()))
    }
    if not transforms:
        raise TrackingError(
            f"{path}: holds no transforms (Seq_Frame0000_ProbeToTrackerTransform); give a tracker "
            f"recording of Plus"
        )
    recording = TrackerRecording(path, times[timed], transforms, len(times) - len(timed))
    if not any(series.valid.any() for series in transforms.values()):
        raise TrackingError(
            f"{path}: none of its {len(times)} samples holds a time and a valid transform"
            f"{recording.explain_gaps(transforms)}"
        )
    return recording


def _rigid(series: FrameTransforms, which: NDArray[np.intp]) -> FrameTransforms:
    """Return some frames' transforms with the rotations nearest to those that trackers round.

    What scales, shears or mirrors is not valid.
    """
    matrices = series.matrices[which].copy()
    faults = [series.faults[k] for k in which]
    for k in np.flatnonzero([not fault for fault in faults]):
        left, scales, right = np.linalg.svd(matrices[k, :3, :3])
        rotation = left @ right
        if np.abs(scales - 1.0).max() > _RIGID or np.linalg.det(rotation) < 0:
            faults[k], matrices[k] = "a transform that is not rigid", np.nan
        else:
            matrices[k, :3, :3] = rotation
    return FrameTransforms(matrices, tuple(faults))
