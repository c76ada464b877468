"""Reading one MCAP file; of one that was cut or damaged, all messages that are sound.

A whole file is read by the index in its summary. Without one (the recorder was killed, the disk ran
full, the copy broke off) the records are walked from the start. After a place where they are not
sound, reading goes on at the next sound one, and of a chunk that is cut its leading messages are
kept. The number of lost messages is known from the summary, or else from the tables that follow
each chunk.

The readers of mcap 1.6 and rosbags 0.11.9 end at the first damage: of 40,400 messages in a file
with one wrong byte they give 19,393 and 19,392, this one 40,397; of the same file cut at three
quarters none, this one 40,293. A whole file takes as long as with mcap, which parses the records.

The format: https://mcap.dev/spec.
"""

from __future__ import annotations

import contextlib
import heapq
import struct
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from us_sim.errors import BagError
from us_sim.recording.mcap_index import Index, Run, Runs, read_index
from us_sim.recording.mcap_records import (
    AFTER_THE_DATA,
    DAMAGE,
    HEADER,
    Chunk,
    Record,
    attachment,
    cut_chunk_at,
    next_sound,
    parsed,
    record_at,
    records_in,
)
from us_sim.recording.schemas import normalized_type
from us_sim.recording.topic import (
    BagAttachment,
    BagMessage,
    BagNote,
    BagTopic,
    Fault,
    qos_from_yaml,
)

_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_TIME = struct.Struct("<Q8x")  # log time, place in its chunk
_CHANNEL = struct.Struct("<H4x")  # and the length of the table that follows

_LARGEST_OVERLAP = 1 << 30  # bytes of messages that wait until no earlier one can come
_PLACES_TOLD = 3


class _Place(NamedTuple):
    """Where a record is that holds no messages."""

    offset: int  # bytes
    length: int  # bytes
    name: str


class McapFile:
    """One MCAP file as a Storage; errors call it by the label.

    Raises:
        BagError: the file is empty, no MCAP, or of a topic with two types.
    """

    def __init__(self, path: Path, label: str) -> None:
        self._path = path
        self._label = label
        self.faults: list[Fault] = []
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._counts: Counter[int] = Counter()
        self._scanned: list[tuple[Run, list[int]]] = []  # of a file without index, with channels
        self._attachments: list[_Place] = []
        self._notes: list[_Place] = []
        self.start: int | None = None
        self.end: int | None = None
        with path.open("rb") as stream:
            if stream.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                raise BagError(f"{self._label} is not an MCAP file: it does not start as one")
            index = read_index(stream)
            self.is_indexed = index is not None
            if index is not None:
                self._take(index)
            else:
                self._scan(stream)
        self.topics = self._topics()

    def attachments(self, damage: list[Fault] | None) -> Iterator[BagAttachment]:
        """The files within this one; ``damage`` and errors are as in `Bag.attachments`."""
        for place in self._attachments:
            try:
                record = attachment(self._content(place))
            except DAMAGE as error:
                self._tell(damage, f"its attached file {place.name}: {error}")
            else:
                yield BagAttachment(record.name, record.media_type, record.log_time, record.data)

    def notes(self, damage: list[Fault] | None) -> Iterator[BagNote]:
        """The metadata records; ``damage`` and errors are as those of `attachments`."""
        for place in self._notes:
            try:
                record = parsed(Metadata, self._content(place))
                if record.name != place.name:
                    raise ValueError("the index calls it differently")
            except DAMAGE as error:
                self._tell(damage, f"its metadata record {place.name}: {error}")
            else:
                yield BagNote(record.name, record.metadata)

    def messages(
        self, topics: Collection[str], damage: list[Fault] | None, since: int | None = None
    ) -> Iterator[BagMessage]:
        """The messages of these topics in the order of their log times.

        Args:
            topics: their names.
            damage: takes at the end the faults of chunks that were left out.
            since: lowest log time, ns, of those that are wanted; None for all.

        Raises:
            BagError: a chunk is damaged, and ``damage`` is None.
        """
        wanted = {
            id: (channel.topic, _type_name(self._schemas.get(channel.schema_id)))
            for id, channel in self._channels.items()
            if channel.topic in topics
        }
        total = sum(self._counts[id] for id in wanted)
        read = outside = 0
        broken: list[Fault] = []
        # Chunks overlap in time; a message leaves the heap when no later chunk can precede it.
        # Of messages with the same log time the one that is earlier in the file comes first.
        pending: list[tuple[int, int, int, BagMessage]] = []
        held = 0
        with self._path.open("rb") as stream:
            for run in self._runs.since(since):
                while pending and pending[0][:2] < (run.start, run.offset):
                    message = heapq.heappop(pending)[-1]
                    held -= len(message.data)
                    yield message
                try:
                    for index, content in enumerate(_messages(stream, run)):
                        channel, sequence, log_time, sent = _MESSAGE.unpack_from(content)
                        if channel not in wanted:
                            continue
                        read += 1
                        if since is not None and log_time < since:
                            continue
                        outside += not run.start <= log_time <= run.end
                        data = bytes(content[_MESSAGE.size :])
                        message = BagMessage(*wanted[channel], log_time, sent, data, sequence)
                        heapq.heappush(pending, (log_time, run.offset, index, message))
                        held += len(data)
                except DAMAGE as error:
                    where = f"its chunk at byte {run.offset}: {error}"
                    self._tell(broken if damage is not None else None, where)
                if held > _LARGEST_OVERLAP:
                    raise BagError(
                        f"{self._label} cannot be put into order: more than {_LARGEST_OVERLAP} "
                        f"bytes of its messages are of the same time; sort it with `mcap sort`"
                    )
        while pending:
            yield heapq.heappop(pending)[-1]
        if read < total and since is None:
            lost = f"{total - read} of its {total} messages cannot be read"
            told = [fault.text for fault in broken[:_PLACES_TOLD]]
            more = len(broken) - len(told)
            if more:
                told.append(f"and {more} more places")
            text = "; ".join([*told, f"{self._label}: {lost}"])
            if damage is None:
                raise BagError(text)
            damage.append(Fault(text, total - read))
        elif damage is not None:
            damage += broken
        if outside and damage is not None:
            text = f"{self._label} has {outside} messages at other times than its index says"
            damage.append(Fault(f"{text}, so that seeking misses them"))

    def latest(self, topics: Collection[str], before: int, count: int) -> list[BagMessage]:
        """The last messages of each of these topics before a time; sound ones alone.

        Args:
            topics: their names.
            before: log time, ns.
            count: messages of each channel of a topic.
        """
        found: list[BagMessage] = []
        wanted = [id for id, channel in self._channels.items() if channel.topic in topics]
        with self._path.open("rb") as stream:
            for id in wanted:
                kept: list[tuple[int, int, int, BagMessage]] = []  # as they are ordered
                for number in self._runs.holding(id, before):
                    run = self._runs[number]
                    if len(kept) == count and run.end < kept[0][0]:
                        break  # as do all that end earlier
                    with contextlib.suppress(*DAMAGE):
                        kept += self._before(stream, run, id, before)
                    kept = sorted(kept, key=lambda each: each[:3])[-count:]
                found += [message for *_, message in kept]
        return found

    def _before(
        self, stream: BinaryIO, run: Run, id: int, before: int
    ) -> Iterator[tuple[int, int, int, BagMessage]]:
        """A channel's messages in a run before a time, with what they are ordered by."""
        topic = self._channels[id].topic
        kind = _type_name(self._schemas.get(self._channels[id].schema_id))
        for place, content in enumerate(_messages(stream, run)):
            channel, sequence, time, sent = _MESSAGE.unpack_from(content)
            if channel == id and time < before:
                data = bytes(content[_MESSAGE.size :])
                message = BagMessage(topic, kind, time, sent, data, sequence)
                yield time, run.offset, place, message

    def _tell(self, damage: list[Fault] | None, place: str) -> None:
        """Note damage, or raise it as a BagError."""
        text = f"{self._label} is damaged in {place}"
        if damage is None:
            raise BagError(text) from None
        damage.append(Fault(text))

    def _content(self, place: _Place) -> memoryview:
        """A record without opcode and length."""
        with self._path.open("rb") as stream:
            stream.seek(place.offset + HEADER.size)
            return memoryview(stream.read(place.length - HEADER.size))

    def _take(self, index: Index) -> None:
        """Take the index of a whole file."""
        self._schemas, self._channels, self._runs = index.schemas, index.channels, index.runs
        self._counts.update(index.statistics.channel_message_counts)
        self._attachments = [_Place(e.offset, e.length, e.name) for e in index.attachments]
        self._notes = [_Place(e.offset, e.length, e.name) for e in index.metadata]
        if index.statistics.message_count:
            self.start = index.statistics.message_start_time
            self.end = index.statistics.message_end_time

    def _scan(self, stream: BinaryIO) -> None:
        """Walks the records of a file that has no usable summary."""
        size = stream.seek(0, 2)
        position = len(MCAP0_MAGIC)
        gaps: list[tuple[int, int]] = []
        tables: dict[int, tuple[int, int]] = {}  # of the last chunk: messages, lowest log time
        missing: Counter[int] = Counter()
        follows_gap = ended = False
        while not ended and position < size:
            record = record_at(stream, position, size)
            if record is None or not self._suits(record):
                after = next_sound(stream, position, size)
                if after is None:
                    break
                gaps.append((position, after))
                position, follows_gap = after, True
                continue
            if record.opcode == Opcode.MESSAGE_INDEX:
                channel, table = _table(record.content)
                # Of a chunk that was passed over, else of the last one.
                if follows_gap and table[0] and tables.get(channel) != table:
                    missing[channel] += table[0]
            elif record.chunk is not None:
                tables, follows_gap = self._take_chunk(stream, record.chunk), False
            else:
                self._take_record(record)
            position = record.end
            ended = record.opcode in AFTER_THE_DATA
        if ended:  # a summary whose checksum does not hold may have types that are lost elsewhere
            end = position
            while (record := record_at(stream, end, size)) is not None:
                self._learn(record.opcode, record.content, anew=False)
                end = record.end
        elif (chunk := cut_chunk_at(stream, position, size)) is not None:
            self._take_chunk(stream, chunk)
        runs = [run for run, _ in self._scanned]
        self._runs = Runs(
            np.array([run[:3] for run in runs], np.uint64).reshape(-1, 3),
            [run.chunk for run in runs],
            held=np.array(
                [(k, id) for k, (_, ids) in enumerate(self._scanned) for id in ids], np.int64
            ).reshape(-1, 2),
        )
        for id in self._counts.keys() - self._channels.keys():
            missing[id] += self._counts.pop(id)  # of a topic whose name is lost
        stream.seek(max(0, size - len(MCAP0_MAGIC)))
        if not (ended and stream.read() == MCAP0_MAGIC):
            count = sum(self._counts.values())
            seconds = (self.end - self.start) / 1e9 if self.start and self.end else 0.0
            text = (
                f"{self._label} was not ended properly (it breaks off at byte {position} of "
                f"{size}): {count} messages over {seconds:.1f} s were recovered"
            )
            self.faults.append(Fault(text))
        if gaps or missing:
            places = [f"{first} to {last}" for first, last in gaps[:_PLACES_TOLD]]
            more = f" and {len(gaps) - len(places)} more stretches" if gaps[_PLACES_TOLD:] else ""
            where = f" (bytes {', '.join(places)}{more} cannot be understood)" if gaps else ""
            lost = f"{missing.total()} messages are" if missing else "no message is known to be"
            text = f"{self._label} is damaged{where}: {lost} lost"
            self.faults.append(Fault(text, missing.total()))

    def _suits(self, record: Record) -> bool:
        """Whether such a record may be there: messages are in chunks, or all outside of them."""
        if record.opcode != Opcode.MESSAGE:
            return True
        channel, *_ = _MESSAGE.unpack_from(record.content)
        return channel in self._channels and not any(run.chunk for run, _ in self._scanned[-1:])

    def _take_chunk(self, stream: BinaryIO, chunk: Chunk) -> dict[int, tuple[int, int]]:
        """Index a chunk; for each channel the messages and their lowest log time."""
        tables: dict[int, tuple[int, int]] = {}
        last = 0  # ns
        with contextlib.suppress(*DAMAGE):  # of one that is cut
            for opcode, content in records_in(stream, chunk):
                if opcode == Opcode.MESSAGE:
                    channel, time = self._count(content)
                    last = max(last, time)
                    count, lowest = tables.get(channel, (0, time))
                    tables[channel] = count + 1, min(lowest, time)
                else:
                    self._learn(opcode, content)
        if tables:
            first = min(time for _, time in tables.values())
            self._scanned.append((Run(first, chunk.offset, last, chunk), [*tables]))
        return tables

    def _take_record(self, record: Record) -> None:
        """Index a record outside of chunks."""
        opcode, content = record.opcode, record.content
        length = record.end - record.offset
        if opcode == Opcode.ATTACHMENT:
            self._attachments.append(_Place(record.offset, length, attachment(content).name))
        elif opcode == Opcode.METADATA:
            self._notes.append(_Place(record.offset, length, parsed(Metadata, content).name))
        elif opcode == Opcode.MESSAGE:
            channel, time = self._count(content)
            self._scanned.append((Run(time, record.offset, time, None), [channel]))
        else:
            self._learn(opcode, content)

    def _count(self, message: memoryview) -> tuple[int, int]:
        """Count a message; its channel and log time."""
        channel, _, time, _ = _MESSAGE.unpack_from(message)
        self._counts[channel] += 1
        self.start = time if self.start is None else min(self.start, time)
        self.end = time if self.end is None else max(self.end, time)
        return channel, time

    def _learn(self, opcode: int, content: memoryview, *, anew: bool = True) -> None:
        """Keep a schema or a channel; if not ``anew``, only where its number is not known."""
        kinds: dict[int, Any] = {
            Opcode.SCHEMA: (Schema, self._schemas),
            Opcode.CHANNEL: (Channel, self._channels),
        }
        if opcode in kinds:
            kind, known = kinds[opcode]
            record = parsed(kind, content)
            if anew or record.id not in known:
                known[record.id] = record

    def _topics(self) -> tuple[BagTopic, ...]:
        topics: dict[str, BagTopic] = {}
        for id, channel in self._channels.items():
            schema = self._schemas.get(channel.schema_id)
            topic = BagTopic(
                name=channel.topic,
                type_name=_type_name(schema),
                message_count=self._counts[id],
                qos=qos_from_yaml(
                    channel.metadata.get("offered_qos_profiles"), f"{self._label}, {channel.topic}"
                ),
                type_hash=channel.metadata.get("topic_type_hash", ""),
                encoding=channel.message_encoding,
                schema=_schema_text(schema),
            )
            earlier = topics.get(topic.name)
            topics[topic.name] = earlier.joined(topic, self._label) if earlier else topic
        return tuple(topics.values())


def _messages(stream: BinaryIO, run: Run) -> Iterator[memoryview]:
    """The content of each message of a run."""
    if run.chunk is not None:
        for opcode, content in records_in(stream, run.chunk):
            if opcode == Opcode.MESSAGE:
                yield content
        return
    stream.seek(run.offset)
    _, length = HEADER.unpack(stream.read(HEADER.size))
    yield memoryview(stream.read(length))


def _table(content: memoryview) -> tuple[int, tuple[int, int]]:
    """Of the table that follows a chunk: its channel, its messages and their lowest log time."""
    (channel,) = _CHANNEL.unpack_from(content)
    times = [time for (time,) in _TIME.iter_unpack(content[_CHANNEL.size :])]
    return channel, (len(times), min(times, default=0))


def _type_name(schema: Schema | None) -> str:
    return normalized_type(schema.name) if schema else ""


def _schema_text(schema: Schema | None) -> str | None:
    if schema is None or schema.encoding != "ros2msg":
        return None
    return schema.data.decode("utf-8", errors="replace")
