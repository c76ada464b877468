"""Recorded sessions as a LeRobot data set: each is an episode, resampled to one rate."""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from us_sim.errors import BagError, TrackingError
from us_sim.recording.lerobot_writer import (
    IMAGES,
    POSE_PARTS,
    STATE,
    WRENCH_PARTS,
    Frame,
    LeRobotWriter,
    require_lerobot,
)
from us_sim.recording.path import POSE_STAMPED, bodies_in, is_pose, pose_rows
from us_sim.recording.reader import Bag, read_bag
from us_sim.recording.resampling import Times, latest, linear, slerp
from us_sim.recording.stamps import stamp_reader
from us_sim.recording.topic import BagTopic
from us_sim.recording.wrench import WRENCH_STAMPED
from us_sim.settings.spelling import counted
from us_sim.tracking.camera.encodings import decode_image, decompress_image

_SECOND = 1_000_000_000
_HIGHEST_RATE = 1000  # Hz
_MOST_FRAMES = 10_000_000
"""Of a session; four days at 30 a second. One wrong stamp can make it last for decades."""
_LATE = _SECOND  # ns that a stamp may be older than one before; more is another time
_LONG = 0.5  # s between two messages, between which frames are told to be interpolated
_PIXELS: Mapping[str, Callable[[Any, str], NDArray[np.uint8]]] = {
    "sensor_msgs/msg/Image": decode_image,
    "sensor_msgs/msg/CompressedImage": decompress_image,
}
_NUMBERS: Mapping[str, Callable[[Any], Iterator[tuple[str, float]]]] = {
    WRENCH_STAMPED: lambda m: zip(
        WRENCH_PARTS, _components(m.wrench.force, m.wrench.torque), strict=True
    ),
    "geometry_msgs/msg/TwistStamped": lambda m: zip(
        ("x", "y", "z", "rx", "ry", "rz"), _components(m.twist.linear, m.twist.angular), strict=True
    ),
    "sensor_msgs/msg/JointState": lambda m: zip(m.name, m.position, strict=False),
}
"""Numbers of messages that have a header, with their names."""
_Timed = tuple[int, int, dict[str, float]]  # stamp and log time, ns, and numbers by their names
Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class Wanted:
    """The parts of sessions that are wanted, and how they are to be resampled.

    Args:
        topics: or bodies, as ``/tf:probe``; where there are none, all topics of a type that is
            known, and bodies of others only without any PoseStamped.
        action: a topic or body that is the action; it may be named here alone.
        rate: frames a second; by default that of the first session's images, or else of the
            fastest topic.
        by_log_time: go by when messages were recorded, and not by their stamps.
    """

    topics: Sequence[str] = ()
    action: str | None = None
    rate: int | None = None
    by_log_time: bool = False


def to_lerobot(
    sessions: Sequence[Path],
    folder: Path,
    wanted: Wanted,
    task: str,
    progress: Progress,
    *,
    is_video: bool = False,
) -> Iterator[str]:
    """Write sessions as episodes, and say of each topic what became of its messages.

    Args:
        sessions: bags of any kind.
        folder: to make.
        wanted: their parts.
        task: in words.
        progress: takes the fraction done, and what is being done.
        is_video: code images as video, which loses speckle.

    Raises:
        BagError: a session cannot be read, or has nothing that is wanted, or at no time all of it.
        EpisodeError: as for `LeRobotWriter`.
    """
    require_lerobot()
    if wanted.rate is not None and not 1 <= wanted.rate <= _HIGHEST_RATE:
        raise BagError(f"--rate: {wanted.rate} is outside 1 to {_HIGHEST_RATE} frames a second")
    episode = Episode(read_bag(sessions[0]), wanted)
    rate = wanted.rate or episode.usual_rate
    frames = 0
    with LeRobotWriter(folder, rate, is_video=is_video) as writer:
        for number, session in enumerate(sessions):
            if number:
                episode = Episode(read_bag(session), wanted)
            moments = episode.moments(rate)
            given = episode.frames(moments, progress)
            writer.write_episode(given, episode.names, task, str(session))
            progress(1.0, "")
            frames += len(moments)
            yield from (f"{session.name}: {sentence}" for sentence in episode.told(moments))
    yield f"{counted(frames, 'frame')} at {rate} Hz in {folder}"


@dataclass
class Images:
    """A topic of images, which are read when they are shown."""

    bag: Bag
    name: str
    times: Times
    numbers: NDArray[np.int64]  # (K,) of the messages, in the order of the recording
    count: int  # of messages
    notes: list[str]  # on messages that are not as they should be
    damaged: int = field(default=0, init=False)  # of those that were to be shown

    @property
    def span(self) -> tuple[int, int]:
        """First and last time, ns."""
        return int(self.times[0]), int(self.times[-1])

    def at(self, moments: Times) -> Iterator[NDArray[np.uint8]]:
        """The latest image of each moment; for one that is damaged the one before."""
        shown = self.numbers[latest(self.times, moments)]
        number, pixels = -1, None
        messages = enumerate(self.bag.messages([self.name]))
        for wanted in shown:
            if number < wanted:
                number, raw = next(each for each in messages if each[0] == wanted)
                try:
                    pixels = _pixels(self.bag, raw)
                except TrackingError as error:
                    self.damaged += 1
                    if pixels is None:
                        raise BagError(f"{self.bag.path}: {self.name}: {error}") from error
            assert pixels is not None
            yield pixels

    def told(self, moments: Times) -> str:
        """The images in numbers, after they were shown."""
        shown = latest(self.times, moments)
        count = len(np.unique(shown))
        oldest = (moments - self.times[shown]).max() / _SECOND
        return (
            f"{self.name}: {count} of {counted(self.count, 'image')} shown, "
            f"{counted(len(moments) - count, 'frame repeats', 'frames repeat')} the one before, "
            f"which is {oldest:.3f} s old at most"
            + (f"; {self.damaged} cannot be decoded" if self.damaged else "")
            + "".join(f"; {note}" for note in self.notes)
        )


@dataclass
class Numbers:
    """A topic of numbers, or a body's poses."""

    name: str
    times: Times
    values: NDArray[np.float64]  # (K, N), NaN where a message has them not
    parts: list[str]  # names of the N
    is_pose: bool
    notes: list[str]  # on messages that are not as they should be

    @property
    def span(self) -> tuple[int, int]:
        """First and last time of which all numbers are known, ns."""
        there = np.isfinite(self.values)
        first, last = there.argmax(axis=0), there[::-1].argmax(axis=0)
        return int(self.times[first.max()]), int(self.times[-1 - last.max()])

    def at(self, moments: Times) -> NDArray[np.float32]:
        """(M, N) interpolated."""
        between = slerp if self.is_pose else linear
        return between(self.times, self.values, moments).astype(np.float32)

    def told(self, moments: Times) -> str:
        """The messages in numbers."""
        after = np.clip(np.searchsorted(self.times, moments), 1, len(self.times) - 1)
        gaps = (self.times[after] - self.times[after - 1]) / _SECOND
        between = "slerp" if self.is_pose else "linear"
        messages = counted(len(self.times), "message")
        told = [f"{self.name}: {between} between {messages}, {gaps.max():.3f} s apart at most"]
        if count := int((gaps > _LONG).sum()):
            lie = counted(count, "frame lies", "frames lie")
            told.append(f"{lie} between messages more than {_LONG} s apart")
        return "; ".join(told + self.notes)


class Episode:
    """The wanted parts of a session.

    Raises:
        BagError: the session has none, or one that was named cannot be used.
    """

    def __init__(self, bag: Bag, wanted: Wanted) -> None:
        self._bag, self._wanted = bag, wanted
        self._left_out = [fault.text for fault in bag.opening_faults]
        self._left_out += [f"the recorder lost {n} of {name}" for name, n in bag.lost().items()]
        self._images: list[Images] = []
        self._numbers: list[Numbers] = []
        self._action = wanted.action and _whole_name(bag, wanted.action)
        named = [_whole_name(bag, name) for name in wanted.topics]
        chosen = named or _known(bag)
        if self._action:
            named.append(self._action)
            chosen = [*chosen, self._action]
        for name in dict.fromkeys(chosen):
            try:
                self._take(name)
            except (BagError, TrackingError) as error:
                if name in named:
                    raise BagError(f"{bag.path}: {name}: {error}") from error
                self._left_out.append(f"{name} is left out: {error}")
        if not self._images and not self._numbers:
            raise BagError(
                f"{bag.path} has no images, poses, wrenches, twists or joint states that can be "
                f"used; {'; '.join(self._left_out) or 'it has other topics alone'}"
            )

    @property
    def usual_rate(self) -> int:
        """Frames a second: of the images, or else of what is fastest."""
        steps = [np.median(np.diff(each.times)) for each in self._images or self._numbers]
        return int(np.clip(round(_SECOND / min(steps)), 1, _HIGHEST_RATE))

    @property
    def names(self) -> dict[str, Sequence[str]]:
        """Of the numbers of each feature."""
        names: dict[str, Sequence[str]] = {STATE: [], "action": []}
        for each in self._numbers:
            head = each.name.strip("/")
            names[self._feature(each)] = [
                *names[self._feature(each)],
                *(f"{head}.{part}" for part in each.parts),
            ]
        return names

    def moments(self, rate: int) -> Times:
        """Times of frames, ns: from when all topics have begun until one of them ends.

        Raises:
            BagError: they are never there at once, or for absurdly long.
        """
        spans = {each.name: each.span for each in self._images}
        spans |= {each.name: each.span for each in self._numbers}
        begin, end = (max(s[0] for s in spans.values()), min(s[1] for s in spans.values()))
        count = int(end - begin) * rate // _SECOND + 1
        if end <= begin or count > _MOST_FRAMES:
            first = min(s[0] for s in spans.values())
            told = ", ".join(
                f"{name} from {(a - first) / _SECOND:.3f} to {(b - first) / _SECOND:.3f} s"
                for name, (a, b) in spans.items()
            )
            raise BagError(
                f"{self._bag.path}: by their stamps there is {told}: name those that go together "
                f"with --topics, or give --by-log-time where clocks differ"
            )
        return begin + np.arange(count) * _SECOND // rate

    def frames(self, moments: Times, progress: Progress = lambda *_: None) -> Iterator[Frame]:
        """The features of each moment."""
        tables: dict[str, list[NDArray[np.float32]]] = {}
        for each in self._numbers:
            tables.setdefault(self._feature(each), []).append(each.at(moments))
        rows = {feature: np.hstack(parts) for feature, parts in tables.items()}
        images = {f"{IMAGES}{_key(each.name)}": each.at(moments) for each in self._images}
        for k in range(len(moments)):
            progress(k / len(moments), self._bag.path.name)
            yield {name: next(pixels) for name, pixels in images.items()} | {
                name: row[k] for name, row in rows.items()
            }

    def told(self, moments: Times) -> Iterator[str]:
        """Sentences on what became of its messages, after the frames were taken."""
        yield counted(len(moments), "frame")
        yield from self._left_out
        yield from (each.told(moments) for each in self._images)
        yield from (each.told(moments) for each in self._numbers)

    def _feature(self, numbers: Numbers) -> str:
        return "action" if numbers.name == self._action else STATE

    def _take(self, name: str) -> None:
        bag, topic = self._bag, self._bag.topic(name.partition(":")[0])
        if topic.type_name in _PIXELS:
            if name == self._action:
                raise BagError("is a topic of images, which are no action")
            stamp = stamp_reader(bag, topic) or (lambda _: None)
            times, kept, count, clock = [-1], [], 0, self._clock()
            for raw in bag.messages([topic.name]):
                with _telling(topic):
                    time = clock.time(stamp(raw.data) or 0, raw.log_time)
                if not count:
                    _pixels(bag, raw)  # refused at once where nothing of it can be decoded
                if time > times[-1]:  # else it came too late to be shown
                    times.append(time)
                    kept.append(count)
                count += 1
            self._require_several(kept)
            arrays = _times(times[1:]), np.array(kept, np.int64)
            self._images.append(Images(bag, name, *arrays, count, clock.notes()))
            return
        is_body = topic.type_name not in _NUMBERS
        frames, clock = dict[str, None](), self._clock()
        rows = list(self._poses(name, frames) if is_body else self._vectors(topic))
        index = _times([clock.time(stamp, log_time) for stamp, log_time, _ in rows])
        table = pd.DataFrame([numbers for *_, numbers in rows], index=index, dtype=float)
        there = np.isfinite(table.to_numpy())
        if is_body and len(table):
            there &= is_pose(table.to_numpy())[:, None]
        if len(frames) > 1:
            raise BagError(f"has poses in the frames {', '.join(frames)}, and a path has one")
        table = table.where(there)
        # Numbers of the same time go together, each as it came first.
        repeated = (table.notna().groupby(level=0).cumsum() > 1) & table.notna()
        table = table.groupby(level=0).first().dropna(how="all").dropna(axis=1, how="all")
        self._require_several(table)
        notes = clock.notes()
        if count := int(repeated.any(axis=1).sum()):
            notes.append(f"{count} have the time of one before and are left out")
        if count := int((~there.any(axis=1)).sum()):
            notes.append(f"{count} are not finite and left out")
        parts, values = list(map(str, table.columns)), table.to_numpy()
        self._numbers.append(Numbers(name, table.index.to_numpy(), values, parts, is_body, notes))

    def _clock(self) -> _Clock:
        return _Clock(self._wanted.by_log_time)

    def _poses(self, name: str, frames: dict[str, None]) -> Iterator[_Timed]:
        for row in pose_rows(self._bag, name):
            frames[row.frame_id] = None
            yield row.stamp, row.log_time, dict(zip(POSE_PARTS, row.pose, strict=True))

    def _vectors(self, topic: BagTopic) -> Iterator[_Timed]:
        for raw in self._bag.messages([topic.name]):
            message = self._bag.deserialize(raw)
            with _telling(topic):
                stamp = message.header.stamp.sec * _SECOND + message.header.stamp.nanosec
                numbers = {str(part): float(x) for part, x in _NUMBERS[topic.type_name](message)}
            yield stamp, raw.log_time, numbers

    @staticmethod
    def _require_several(messages: Any) -> None:
        if len(messages) < 2:
            raise BagError(f"has {counted(len(messages), 'message')} of use, and two are needed")


class _Clock:
    """The times of a topic's messages, ns: their stamps, or when they were recorded."""

    def __init__(self, by_log_time: bool) -> None:
        self._by_log_time = by_log_time
        self._newest: int | None = None
        self._late = self._unstamped = 0

    def time(self, stamp: int, log_time: int) -> int:
        """The time of the next message in the recording.

        Raises:
            BagError: it is of another time, as after a clock was set back.
        """
        self._unstamped += not stamp and not self._by_log_time
        time = log_time if self._by_log_time else stamp or log_time
        back = 0 if self._newest is None else self._newest - time
        if back > _LATE:
            raise BagError(
                f"its stamps go back by {back / _SECOND:.1f} s, so nobody knows which messages go "
                f"together: give --by-log-time"
            )
        self._late += back > 0
        self._newest = time if back < 0 or self._newest is None else self._newest
        return time

    def notes(self) -> list[str]:
        """What of the times so far is not as it should be."""
        unstamped = counted(self._unstamped, "message has", "messages have")
        late = counted(self._late, "message is", "messages are")
        return [
            *[f"{unstamped} no stamp, but the time of recording"][: self._unstamped],
            *[f"{late} stamped before one that was recorded earlier"][: self._late],
        ]


def _whole_name(bag: Bag, name: str) -> str:
    """A topic's or body's name with its leading slash, where the bag has one."""
    topic, colon, body = name.partition(":")
    return bag.topic(topic).name + colon + body


def _known(bag: Bag) -> list[str]:
    """Topics with messages of a type that is known; bodies of others without a PoseStamped."""
    there = [topic for topic in bag.topics if topic.message_count]
    stamped = [topic.name for topic in there if topic.type_name == POSE_STAMPED]
    return [
        *(topic.name for topic in there if topic.type_name in (*_PIXELS, *_NUMBERS)),
        *(stamped or [name for names in bodies_in(bag).values() for name in names]),
    ]


@contextlib.contextmanager
def _telling(topic: BagTopic) -> Iterator[None]:
    """Refuse messages that are not what their type is in ROS 2."""
    try:
        yield
    except (AttributeError, IndexError, TypeError, ValueError, struct.error) as error:
        raise BagError(f"holds {topic.type_name} unlike that of ROS 2: {error}") from None


def _pixels(bag: Bag, raw: Any) -> NDArray[np.uint8]:
    return _PIXELS[bag.topic(raw.topic).type_name](bag.deserialize(raw), "RGB")


def _components(*vectors: Any) -> list[float]:
    return [each for vector in vectors for each in (vector.x, vector.y, vector.z)]


def _times(nanoseconds: list[int]) -> Times:
    try:
        return np.array(nanoseconds, np.int64)
    except OverflowError as error:
        raise BagError("has a time that is no number of 64 bits") from error


def _key(topic: str) -> str:
    """A topic's name as part of a feature's, in which lerobot allows no slash."""
    return topic.strip("/").replace("/", "_")
