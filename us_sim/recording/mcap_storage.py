"""Reading one MCAP file: by the index in its summary, or else by a walk through its records.

The records are mcap's. Its ``iter_messages`` is not used: it ends at the first damaged chunk and
before the end of a file that was cut, and takes 3.4 times as long as this for small messages.
"""

from __future__ import annotations

import heapq
import struct
import zlib
from collections import Counter
from collections.abc import Collection, Iterator, Set
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Chunk, Metadata, Schema
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC

from us_sim.errors import BagError
from us_sim.recording.schemas import normalized_type
from us_sim.recording.topic import (
    BagAttachment,
    BagMessage,
    BagNote,
    BagTopic,
    Fault,
    qos_from_yaml,
)

_HEADER = struct.Struct("<BQ")  # opcode, length of what follows
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_CHUNK = struct.Struct("<QQQII")  # start, end, size, CRC, length of the compression's name
_LENGTH = 8  # bytes
_CRC = struct.Struct("<I")
_LAST = 2**63 - 1  # ns
_PLACES_TOLD = 3

_DAMAGE = (
    *(McapError, zstandard.ZstdError, struct.error, RuntimeError),  # the last one of lz4
    *(OverflowError, ValueError, KeyError, MemoryError),
)
"""Errors that the parsers raise for damaged bytes."""


class _Run(NamedTuple):
    """A stretch of the file that holds messages: a chunk, or a message outside of chunks."""

    start: int  # ns, lowest log time in it
    offset: int  # bytes, of its record's opcode
    end: int  # ns, highest log time in it
    length: int  # bytes of its record
    channels: tuple[int, ...]  # of its messages; none where the index does not say


_Place = tuple[int, int]  # offset and length of a record, bytes
_Ordered = tuple[int, int, int, BagMessage]  # log time, offset of the run, place in it, message


@dataclass
class _Contents:
    """What a file holds, and where."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: Counter[int] = field(default_factory=Counter)  # messages by channel
    runs: list[_Run] = field(default_factory=list)
    attachments: list[_Place] = field(default_factory=list)
    notes: list[_Place] = field(default_factory=list)

    def add(self, offset: int, record: bytes) -> None:
        """Note what a record holds.

        Raises:
            _DAMAGE: it is not sound.
        """
        opcode = record[0]
        if opcode == Opcode.ATTACHMENT:
            self.attachments.append((offset, len(record)))
        elif opcode == Opcode.METADATA:
            self.notes.append((offset, len(record)))
        heads = []
        for inner, content in _records_in(record):
            if inner == Opcode.MESSAGE:
                heads.append(_MESSAGE.unpack_from(content))
            elif inner == Opcode.SCHEMA:
                schema = _parsed(Schema, content)
                self.schemas[schema.id] = schema
            elif inner == Opcode.CHANNEL:
                channel = _parsed(Channel, content)
                self.channels[channel.id] = channel
        if heads:
            times = [time for _, _, time, _ in heads]
            counts = Counter(channel for channel, *_ in heads)
            self.runs.append(_Run(min(times), offset, max(times), len(record), tuple(counts)))
            self.counts += counts


class McapStorage:
    """One MCAP file as a Storage; errors call it by the label.

    Raises:
        BagError: it holds a topic of two types.
    """

    def __init__(self, path: Path, label: str) -> None:
        self._path = path
        self._label = label
        self.faults: list[Fault] = []
        with path.open("rb") as stream:
            indexed = _indexed(stream)
            self._held = indexed or self._walked(stream)
        self.is_indexed = indexed is not None
        self._held.runs.sort()
        self.start = min((run.start for run in self._held.runs), default=None)
        self.end = max((run.end for run in self._held.runs), default=None)
        self.topics = self._topics()

    def attachments(self, damage: list[Fault] | None) -> Iterator[BagAttachment]:
        """The files within this one; ``damage`` and errors are as in `Bag.attachments`."""
        for each in self._parsed_at(self._held.attachments, Attachment, "attached file", damage):
            yield BagAttachment(each.name, each.media_type, each.log_time, each.data)

    def notes(self, damage: list[Fault] | None) -> Iterator[BagNote]:
        """The metadata records; ``damage`` and errors are as those of `attachments`."""
        for each in self._parsed_at(self._held.notes, Metadata, "metadata record", damage):
            yield BagNote(each.name, each.metadata)

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
            id: (channel.topic, _type_name(self._held.schemas.get(channel.schema_id)))
            for id, channel in self._held.channels.items()
            if channel.topic in topics
        }
        broken: list[str] = []
        read, total = 0, sum(self._held.counts[id] for id in wanted)
        # Chunks overlap in time; a message leaves the heap when no later chunk can precede it.
        # Of messages with the same log time the one that is earlier in the file comes first.
        pending: list[_Ordered] = []
        with self._path.open("rb") as stream:
            for run in self._held.runs:
                if (since is not None and run.end < since) or not _may_hold(run, wanted.keys()):
                    continue
                while pending and pending[0][:2] < (run.start, run.offset):
                    yield heapq.heappop(pending)[-1]
                try:
                    for each in _messages(stream, run, wanted):
                        read += 1
                        if since is None or each[0] >= since:
                            heapq.heappush(pending, each)
                except _DAMAGE as error:
                    broken.append(f"its chunk at byte {run.offset}: {error}")
                    if damage is None:
                        self._tell(None, f"is damaged in {broken[0]}")
        while pending:
            yield heapq.heappop(pending)[-1]
        lost = total - read if since is None else 0
        if broken or lost:
            where = "; ".join(broken[:_PLACES_TOLD]) or "its index"
            count = f": {lost} of its {total} messages cannot be read" if lost else ""
            self._tell(damage, f"is damaged in {where}{count}", lost)

    def _walked(self, stream: BinaryIO) -> _Contents:
        """Find the contents of a file without an index, up to where it was cut."""
        found, position, is_ended = _Contents(), len(MCAP0_MAGIC), False
        size = stream.seek(-len(MCAP0_MAGIC), 2) + len(MCAP0_MAGIC)
        has_magic = stream.read() == MCAP0_MAGIC
        while position + _HEADER.size <= size and not is_ended:
            stream.seek(position)
            opcode, length = _HEADER.unpack(stream.read(_HEADER.size))
            end = position + _HEADER.size + length
            if end > size or not opcode:  # zeros are what a power cut leaves
                break
            is_ended = opcode == Opcode.DATA_END
            stream.seek(position)
            try:
                found.add(position, stream.read(end - position))
            except _DAMAGE as error:
                self._tell(self.faults, f"is damaged in its record at byte {position}: {error}")
            position = end
        if not (is_ended and has_magic):
            times = [time for run in found.runs for time in (run.start, run.end)] or [0]
            text = (
                f"was not ended properly (it breaks off at byte {position} of {size}): "
                f"{found.counts.total()} messages over {(max(times) - min(times)) / 1e9:.1f} s "
                f"were recovered"
            )
            self._tell(self.faults, text)
        return found

    def _tell(self, faults: list[Fault] | None, what: str, lost: int = 0) -> None:
        """Note a fault, or raise it as a BagError."""
        if faults is None:
            remedy = "`us-sim bag repair` writes all that can be read as a new bag"
            raise BagError(f"{self._label} {what}; {remedy}") from None
        faults.append(Fault(f"{self._label} {what}", lost))

    def _parsed_at(
        self, places: list[_Place], kind: Any, what: str, damage: list[Fault] | None
    ) -> Iterator[Any]:
        """Records of a kind, of which one of an attachment has a checksum of its own."""
        size = self._path.stat().st_size
        with self._path.open("rb") as stream:
            for offset, length in places:
                stream.seek(min(offset, size))
                content = memoryview(stream.read(min(length, size)))[_HEADER.size :]
                try:
                    record = _parsed(kind, content)
                    crc = kind is Attachment and _CRC.unpack_from(content[-_CRC.size :])[0]
                    if crc and zlib.crc32(content[: -_CRC.size]) != crc:
                        raise ValueError(f"the checksum of {record.name} does not match")
                except _DAMAGE as error:
                    self._tell(damage, f"is damaged in its {what}: {error}")
                else:
                    yield record

    def _topics(self) -> tuple[BagTopic, ...]:
        topics: dict[str, BagTopic] = {}
        for id, channel in self._held.channels.items():
            schema = self._held.schemas.get(channel.schema_id)
            is_text = schema is not None and schema.encoding == "ros2msg"
            topic = BagTopic(
                name=channel.topic,
                type_name=_type_name(schema),
                message_count=self._held.counts[id],
                qos=qos_from_yaml(
                    channel.metadata.get("offered_qos_profiles"), f"{self._label}, {channel.topic}"
                ),
                type_hash=channel.metadata.get("topic_type_hash", ""),
                encoding=channel.message_encoding,
                schema=schema.data.decode(errors="replace") if schema and is_text else None,
            )
            earlier = topics.get(topic.name)
            topics[topic.name] = earlier.joined(topic, self._label) if earlier else topic
        return tuple(topics.values())


def _indexed(stream: BinaryIO) -> _Contents | None:
    """Read the contents of a file by its index; None where there is none of every chunk."""
    try:
        summary = make_reader(stream).get_summary()
    except (*_DAMAGE, OSError):
        return None
    said = summary.statistics if summary else None
    if (
        summary is None
        or said is None
        or len(summary.chunk_indexes) != said.chunk_count
        or (said.message_count and not said.chunk_count)
        or not summary.channels.keys() >= said.channel_message_counts.keys()
    ):
        return None
    runs = [
        _Run(
            each.message_start_time,
            each.chunk_start_offset,
            each.message_end_time,
            each.chunk_length,
            tuple(each.message_index_offsets),
        )
        for each in summary.chunk_indexes
    ]
    return _Contents(
        summary.schemas,
        summary.channels,
        Counter(said.channel_message_counts),
        runs,
        [(each.offset, each.length) for each in summary.attachment_indexes],
        [(each.offset, each.length) for each in summary.metadata_indexes],
    )


def _parsed(kind: Any, content: memoryview) -> Any:
    return kind.read(ReadDataStream(BytesIO(content)))


def _records_in(record: bytes) -> Iterator[tuple[int, memoryview]]:
    """Opcode and content of each record in a chunk; of another record, its own.

    Raises:
        _DAMAGE: it is not sound.
    """
    content = memoryview(record)[_HEADER.size :]
    if record[0] != Opcode.CHUNK:
        yield record[0], content
        return
    *_, crc, name = _CHUNK.unpack_from(content)
    held, position = content[_CHUNK.size + name + _LENGTH :], 0
    if name:  # of a compression
        stream, size = get_chunk_data_stream(_parsed(Chunk, content), validate_crc=True)
        held = memoryview(stream.read(size))
    elif crc and zlib.crc32(held) != crc:  # here, since mcap copies what is not compressed
        raise ValueError("its checksum does not match")
    while position < len(held):
        opcode, length = _HEADER.unpack_from(held, position)
        position += _HEADER.size + length
        if position > len(held):
            raise ValueError("its records break off")
        yield opcode, held[position - length : position]


def _may_hold(run: _Run, channels: Set[int]) -> bool:
    return not run.channels or not channels.isdisjoint(run.channels)


def _messages(
    stream: BinaryIO, run: _Run, wanted: dict[int, tuple[str, str]]
) -> Iterator[_Ordered]:
    """The messages of a run on channels of which name and type are given.

    Raises:
        _DAMAGE: it is not sound.
    """
    stream.seek(run.offset)
    record = stream.read(run.length)
    if record[:1] not in (bytes([Opcode.CHUNK]), bytes([Opcode.MESSAGE])):
        raise ValueError("the index says that there is one")
    for place, (opcode, content) in enumerate(_records_in(record)):
        if opcode == Opcode.MESSAGE:
            channel, sequence, time, sent = _MESSAGE.unpack_from(content)
            if channel in wanted:
                if time > _LAST or sent > _LAST:
                    raise ValueError("a message is of a time after the year 2262")
                data = bytes(content[_MESSAGE.size :])
                message = BagMessage(*wanted[channel], time, sent, data, sequence)
                yield time, run.offset, place, message


def _type_name(schema: Schema | None) -> str:
    return normalized_type(schema.name) if schema else ""
