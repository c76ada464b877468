"""Reading bags: MCAP or SQLite, one file or a folder, whole or cut off."""

from __future__ import annotations

import contextlib
import heapq
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Collection, Iterator
from itertools import chain, takewhile
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from rosbags.interfaces import Nodetype, Qos
from rosbags.typesys.store import Typestore

from us_sim.errors import BagError, printable_line
from us_sim.recording import MARKER
from us_sim.recording.decoding import read_first_stamp, read_stamp
from us_sim.recording.metadata import METADATA, missing_files
from us_sim.recording.schemas import load_jazzy_definitions, parse_definitions
from us_sim.recording.storage import Storage, find_bag_files, open_storage
from us_sim.recording.topic import LOST, BagMessage, BagTopic
from us_sim.settings.spelling import align_columns

_HEADER = (Nodetype.NAME, "std_msgs/msg/Header")


class Bag:
    """A bag opened for reading; made by :func:`read_bag`.

    Attributes:
        start: lowest log time in ns since the epoch; None without messages.
        end: highest log time.
        message_count: on all topics.
        attachments: the files within it, such as the scene that was recorded, by their names.
        notes: the texts that it holds beside its messages.
        fault: what was found to be wrong when it was opened; empty where nothing was.
    """

    def __init__(self, path: Path, storages: list[Storage]) -> None:
        self.path = path
        self._storages = storages
        topics: dict[str, BagTopic] = {}
        for topic in (topic for storage in storages for topic in storage.topics):
            earlier = topics.get(topic.name)
            topics[topic.name] = earlier.merge_topic(topic, str(path)) if earlier else topic
        self.topics = tuple(topics.values())
        self._topics = topics
        starts, ends = [each.start for each in storages], [each.end for each in storages]
        self.start = min((time for time in starts if time is not None), default=None)
        self.end = max((time for time in ends if time is not None), default=None)
        self.message_count = sum(topic.message_count for topic in self.topics)
        self.attachments = {each.name: each for storage in storages for each in storage.attachments}
        self.notes = [note for storage in storages for note in storage.notes]
        faults = [storage.fault for storage in storages if storage.fault]
        if missing := missing_files(path):
            faults.append(f"{path / METADATA} names files that are not there: {', '.join(missing)}")
        self.fault = "; ".join(faults)

    def find_topic(self, name: str) -> BagTopic:
        """Return the topic of this name, with or without its leading slash.

        Raises:
            BagError: the bag has no such topic.
        """
        for candidate in (name, f"/{name}", name.removeprefix("/")):
            if candidate in self._topics:
                return self._topics[candidate]
        raise BagError(
            f"{self.path} has no topic {name}; it has {', '.join(sorted(self._topics)) or 'none'}"
        )

    def read_markers(self) -> list[tuple[int, str]]:
        """Return the moments that a person marked: ns since the epoch, and the text."""
        topics = [each.name for each in self.topics if each.name.endswith(f"/{MARKER}")]
        return [
            (each.log_time, self.deserialize(each).data) for each in self.read_messages(topics, [])
        ]

    def count_losses(self) -> Counter[str]:
        """Count the messages that the recorder says that it lost, by topic."""
        lost: Counter[str] = Counter()
        for note in self.notes:
            if note.name == LOST:
                lost.update({topic: _count(text) for topic, text in note.metadata.items()})
        return lost

    def read_all_messages(self, faults: list[str]) -> Iterator[BagMessage]:
        """Yield every message that can be read; ``faults`` takes everything that is wrong."""
        faults += [self.fault] if self.fault else []
        try:
            yield from self.read_messages(damage=faults)
        except BagError as error:
            faults.append(str(error))

    def read_messages(
        self,
        topics: Collection[str] | None = None,
        damage: list[str] | None = None,
        since: int | None = None,
    ) -> Iterator[BagMessage]:
        """Yield the messages of all topics or of these, in the order of their log times.

        Args:
            topics: their names; None for all.
            damage: takes a sentence for each damaged part, which is then left out.
            since: the lowest log time of those that are wanted, ns; what is before is not read
                where there is an index. None for all.

        Raises:
            BagError: the bag has no such topic, or is damaged and ``damage`` is None.
        """
        names = (
            {self.find_topic(name).name for name in topics} if topics is not None else self._topics
        )
        streams = [storage.read_messages(names, damage, since) for storage in self._storages]
        yield from map(_unpack, heapq.merge(*streams, key=lambda message: message.log_time))

    def read_latest(self, topics: Collection[str], before: int, count: int) -> list[BagMessage]:
        """Return the last messages of each topic before a time, in the order of log times.

        Args:
            topics: their names.
            before: log time, ns.
            count: messages of each topic.

        Raises:
            BagError: the bag has no such topic.
        """
        last: dict[str, deque[BagMessage]] = defaultdict(lambda: deque(maxlen=count))
        for message in takewhile(
            lambda each: each.log_time < before, self.read_messages(topics, [])
        ):
            last[message.topic].append(message)
        return sorted(chain(*last.values()), key=lambda message: message.log_time)

    def deserialize(self, message: BagMessage) -> Any:
        """Return the message as a rosbags dataclass, by the definition that the bag carries.

        Raises:
            BagError: it is not CDR, its type is unknown, or its bytes do not fit the type.
        """
        topic = self._topics[message.topic]
        if topic.encoding != "cdr":
            raise BagError(
                f"{self.path} holds {topic.name} in the encoding {topic.encoding!r}: only cdr, "
                f"what ROS 2 writes, can be read"
            )
        store = self.find_definitions(topic)
        try:
            return store.deserialize_cdr(message.data, topic.type_name)
        except Exception as error:  # generated decoders may raise anything for wrong bytes
            raise BagError(
                f"{self.path} holds a message on {topic.name} at {message.log_time} ns that is no "
                f"{topic.type_name}: {error}"
            ) from None

    def find_definitions(self, topic: BagTopic) -> Typestore:
        """Return the definition of a topic's type: the bag's own, else that of Jazzy.

        Raises:
            BagError: it cannot be understood, or there is none.
        """
        if topic.schema is not None:
            try:
                return parse_definitions(topic.type_name, topic.schema)
            except BagError as error:
                raise BagError(f"{self.path}, {topic.name}: {error}") from None
        store = load_jazzy_definitions()
        if topic.type_name not in store.fielddefs:
            raise BagError(
                f"{self.path} holds {topic.name} of type {topic.type_name} without its "
                f"definition: record it again with MCAP, which carries definitions"
            )
        return store

    def make_stamp_reader(self, topic: BagTopic) -> Callable[[bytes], int | None] | None:
        """Return a function from a message's bytes to its stamp in ns; None where it has no header.

        The type must begin with a header, or with a sequence of such, of which the first counts, as
        in tf. The function gives None for an empty sequence.

        The function raises struct.error for a message that is too short to have a stamp.
        """
        try:
            fields = self.find_definitions(topic).fielddefs if topic.encoding == "cdr" else {}
        except BagError:
            return None

        def first_field(type_name: str) -> Any:
            _, own = fields.get(type_name, (None, []))
            return own[0][1] if own else (None, None)

        kind, content = first_field(topic.type_name)
        if (kind, content) == _HEADER:
            return read_stamp
        if kind == Nodetype.SEQUENCE and content[0][0] == Nodetype.NAME:
            return read_first_stamp if first_field(content[0][1]) == _HEADER else None
        return None


def _unpack(message: BagMessage) -> BagMessage:
    """Unpack a message where rosbag2 compressed each one by itself.

    A frame of zstd is known by its first bytes, which no CDR has.
    """
    if message.data.startswith(zstandard.FRAME_HEADER):
        with contextlib.suppress(zstandard.ZstdError):
            return message._replace(data=zstandard.decompress(message.data))
    return message


def _count(text: str) -> int:
    """Return the number that a note holds; 0 for any other text."""
    return int(text) if text.isascii() and text.isdecimal() and len(text) < 20 else 0


def read_bag(path: str | Path, *further: Path) -> Bag:
    """Open a bag for reading.

    Args:
        path: an MCAP or SQLite file, or a folder with those of one bag.
        further: files in which the recording goes on.

    Raises:
        BagError: there is no bag, or it cannot be read; a file that is only cut off can.

    Examples:
        >>> import tempfile
        >>> from us_sim.recording.writer import BagWriter
        >>> file = tempfile.mkdtemp() + "/note.mcap"
        >>> with BagWriter(file) as writer:
        ...     writer.add_topic("/note", "std_msgs/msg/String")
        ...     hi = bytes.fromhex("00010000 03000000 686900")
        ...     writer.write_message("/note", hi, 1_700_000_000_000_000_000)
        >>> bag = read_bag(file)
        >>> [bag.deserialize(message).data for message in bag.read_messages()]
        ['hi']
    """
    path = Path(path)
    try:
        return Bag(path, [open_storage(file) for file in (*find_bag_files(path), *further)])
    except OSError as error:
        raise BagError(f"{path} cannot be read: {error.strerror or error}") from None


def describe_bag(bag: Bag) -> str:
    """Tell path, times, topics with their rates and offered quality, then losses, marks, files.

    The times of marks are those since the start. All of the bag is read, for its faults.
    """
    start, faults = bag.start, list[str]()
    times: dict[str, tuple[int, int]] = {}  # ns, first and last of a topic
    for message in bag.read_all_messages(faults):
        first, _ = times.get(message.topic, (message.log_time, 0))
        times[message.topic] = first, message.log_time
    seconds = (bag.end - start) * 1e-9 if start is not None and bag.end is not None else 0.0
    lines = [f"file      {bag.path}"]
    lines += [f"note      {fault}" for fault in faults]
    if start is not None:
        lines.append(f"start     {np.datetime64(start, 'ns').astype('datetime64[ms]')}+00:00")
    lines += [f"duration  {seconds:.3f} s", f"messages  {bag.message_count}", ""]
    table = [("topic", "type", "count", "Hz", "quality of service")]
    for topic in sorted(bag.topics, key=lambda topic: topic.name):
        count = topic.message_count
        first, last = times.get(topic.name, (0, 0))
        rate = f"{(count - 1) / (last - first) * 1e9:.1f}" if last > first else "-"
        quality = "; ".join(dict.fromkeys(map(_summary, topic.qos))) or "-"
        encoding = "" if topic.encoding == "cdr" else f" ({topic.encoding})"
        table.append((topic.name, topic.type_name + encoding, str(count), rate, quality))
    lines += align_columns(table, left=(0, 1, 4))
    lines += _section(
        "lost", [f"{count} of {topic}" for topic, count in bag.count_losses().items()]
    )
    marks = [
        f"{(time - (start or time)) * 1e-9:.3f} s  {text}" for time, text in bag.read_markers()
    ]
    lines += _section("marked", marks)
    attached = bag.attachments.values()
    lines += _section("attached", [f"{each.name} ({len(each.data)} bytes)" for each in attached])
    return "\n".join(printable_line(line) for line in lines)


def _summary(qos: Qos) -> str:
    """Write the first four policies of a profile."""
    return (
        f"history: {qos.history.name} depth: {qos.depth} reliability: {qos.reliability.name} "
        f"durability: {qos.durability.name}"
    ).lower()


def _section(title: str, entries: list[str]) -> list[str]:
    """Return lines under a title, or none."""
    return ["", title, *(f"  {entry}" for entry in entries)] if entries else []
