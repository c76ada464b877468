"""Reading one MCAP file. Of a file that was cut off, what was written before the cut is recovered.

A whole file is read by the index in its summary. Without one (the recorder was killed, the disk
ran full, the copy broke off) the records are walked from the start up to the first that is not
there in full, and of a chunk that is cut its leading messages are kept.

The format: https://mcap.dev/spec.
"""

from __future__ import annotations

import contextlib
import heapq
import struct
import zlib
from collections import Counter
from collections.abc import Collection, Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Attachment, Channel, Metadata, Schema
from mcap.summary import Summary

from us_sim.errors import BagError
from us_sim.recording.qos import qos_from_yaml
from us_sim.recording.schemas import normalized_type
from us_sim.recording.topic import BagAttachment, BagMessage, BagNote, BagTopic
from us_sim.recording.unpacking import LARGEST_CHUNK, unpack

__all__ = ["MAGIC", "McapFile"]

MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")  # opcode, length of what follows
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_FOOTER = struct.Struct("<BQQQI")  # opcode, length, start of the summary and its offsets, CRC
_CHUNK = struct.Struct("<QQQII")  # start, end, uncompressed size, CRC, length of compression name

_LARGEST_OVERLAP = 1 << 30
"""Bytes of messages that wait until no earlier one can come."""

_DAMAGE = (
    McapError,
    EOFError,
    OverflowError,
    zstandard.ZstdError,
    struct.error,
    ValueError,
    KeyError,
    RuntimeError,
    StopIteration,
    MemoryError,
)
"""Errors that the parsers raise for damaged bytes."""


class _Run(NamedTuple):
    """A stretch of the file that holds messages: a chunk, or records outside of chunks."""

    start: int  # ns, lowest log time in it
    offset: int  # bytes, of its first record's opcode
    length: int  # bytes


class McapFile:
    """One MCAP file as a Storage.

    Args:
        path: the file.
        label: its name in errors, where that is not its path.

    Raises:
        BagError: the file is empty, no MCAP, or of a topic with two types.
    """

    def __init__(self, path: Path, label: str = "") -> None:
        self._path = path
        self._label = label or str(path)
        self.note = ""
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._counts: Counter[int] = Counter()
        self._runs: list[_Run] = []
        self._attachments: list[tuple[int, int]] = []  # offset and length of each record
        self._notes: list[tuple[int, int]] = []
        self.start: int | None = None
        self.end: int | None = None
        with path.open("rb") as stream:
            if stream.read(len(MAGIC)) != MAGIC:
                raise BagError(f"{self._label} is not an MCAP file: it does not start as one")
            summary = _summary(stream)
            if summary is not None:
                self._take(summary)
            else:
                self._scan(stream)
        self.topics = self._topics()

    def attachments(self) -> Iterator[BagAttachment]:
        """The files within this one; those that are damaged are left out."""
        for content in self._contents(self._attachments):
            with contextlib.suppress(*_DAMAGE):
                record = Attachment.read(_data_stream(content))
                yield BagAttachment(record.name, record.media_type, record.log_time, record.data)

    def notes(self) -> Iterator[BagNote]:
        """The metadata records; those that are damaged are left out."""
        for content in self._contents(self._notes):
            with contextlib.suppress(*_DAMAGE):
                record = Metadata.read(_data_stream(content))
                yield BagNote(record.name, record.metadata)

    def messages(
        self, topics: Collection[str], damage: list[str] | None = None
    ) -> Iterator[BagMessage]:
        """The messages of these topics in the order of their log times.

        Args:
            topics: their names.
            damage: takes a sentence for each damaged chunk, which is then left out.

        Raises:
            BagError: a chunk is damaged, and ``damage`` is None.
        """
        wanted = {
            id: (channel.topic, _type_name(self._schemas.get(channel.schema_id)))
            for id, channel in self._channels.items()
            if channel.topic in topics
        }
        # Chunks overlap in time; a message leaves the heap when no later chunk can precede it.
        # Of messages with the same log time the one that is earlier in the file comes first.
        pending: list[tuple[int, int, int, BagMessage]] = []
        held = 0
        with self._path.open("rb") as stream:
            for run in self._runs:
                while pending and pending[0][0] < run.start:
                    message = heapq.heappop(pending)[-1]
                    held -= len(message.data)
                    yield message
                for index, content in enumerate(self._run_messages(stream, run, damage)):
                    channel, log_time, publish_time, data = content
                    if channel in wanted:
                        message = BagMessage(*wanted[channel], log_time, publish_time, bytes(data))
                        heapq.heappush(pending, (log_time, run.offset, index, message))
                        held += len(message.data)
                if held > _LARGEST_OVERLAP:
                    raise BagError(
                        f"{self._label} cannot be put into order: more than {_LARGEST_OVERLAP} "
                        f"bytes of its messages are of the same time; sort it with `mcap sort`"
                    )
        while pending:
            yield heapq.heappop(pending)[-1]

    def _contents(self, places: list[tuple[int, int]]) -> Iterator[memoryview]:
        """The records at these places, without opcode and length."""
        with self._path.open("rb") as stream:
            for offset, length in places:
                with contextlib.suppress(*_DAMAGE):
                    for _, content in _records(stream, offset, length, self._label):
                        yield content

    def _take(self, summary: Summary) -> None:
        """Believes the summary of a whole file."""
        assert summary.statistics is not None
        self._schemas = summary.schemas
        self._channels = summary.channels
        self._counts.update(summary.statistics.channel_message_counts)
        self._runs = sorted(
            _Run(chunk.message_start_time, chunk.chunk_start_offset, chunk.chunk_length)
            for chunk in summary.chunk_indexes
        )
        self._attachments = [(each.offset, each.length) for each in summary.attachment_indexes]
        self._notes = [(each.offset, each.length) for each in summary.metadata_indexes]
        if summary.statistics.message_count:
            self.start = summary.statistics.message_start_time
            self.end = summary.statistics.message_end_time

    def _scan(self, stream: BinaryIO) -> None:
        """Walks the records of a file that has no usable summary."""
        size = stream.seek(0, 2)
        position = len(MAGIC)
        ended = False
        while not ended:
            stream.seek(position)
            header = stream.read(_RECORD.size)
            if len(header) < _RECORD.size:
                break
            opcode, length = _RECORD.unpack(header)
            whole = position + _RECORD.size + length <= size
            if opcode == 0 or not (whole or opcode == Opcode.CHUNK):
                break  # a zero is what file systems fill a lost block with
            ended = opcode == Opcode.DATA_END
            if opcode in (Opcode.CHUNK, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
                run_length = _RECORD.size + min(length, size - position - _RECORD.size)
                try:
                    self._scan_run(stream, position, run_length)
                except _DAMAGE:
                    break
            if not whole:
                break
            if opcode == Opcode.ATTACHMENT:
                self._attachments.append((position, _RECORD.size + length))
            elif opcode == Opcode.METADATA:
                self._notes.append((position, _RECORD.size + length))
            position += _RECORD.size + length
        self._runs.sort()
        stream.seek(max(0, size - len(MAGIC)))
        if not (ended and stream.read() == MAGIC):
            count = sum(self._counts.values())
            seconds = (self.end - self.start) / 1e9 if self.start and self.end else 0.0
            self.note = (
                f"{self._label} was not ended properly (it breaks off at byte {position} of "
                f"{size}): {count} messages over {seconds:.1f} s were recovered"
            )

    def _scan_run(self, stream: BinaryIO, offset: int, length: int) -> None:
        """Learns schemas, channels, counts and times of one record or chunk."""
        first: int | None = None
        for opcode, content in _records(stream, offset, length, self._label):
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(_data_stream(content))
                self._schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(_data_stream(content))
                self._channels[channel.id] = channel
            elif opcode == Opcode.MESSAGE:
                id, _, log_time, _ = _MESSAGE.unpack_from(content)
                if id not in self._channels:
                    continue
                self._counts[id] += 1
                first = log_time if first is None else min(first, log_time)
                self.start = log_time if self.start is None else min(self.start, log_time)
                self.end = log_time if self.end is None else max(self.end, log_time)
        if first is not None:
            self._runs.append(_Run(first, offset, length))

    def _run_messages(
        self, stream: BinaryIO, run: _Run, damage: list[str] | None = None
    ) -> Iterator[tuple[int, int, int, memoryview]]:
        """Channel, log time, publish time and data of each message of a run."""
        try:
            for opcode, content in _records(stream, run.offset, run.length, self._label):
                if opcode == Opcode.MESSAGE:
                    channel, _, log_time, publish_time = _MESSAGE.unpack_from(content)
                    yield channel, log_time, publish_time, content[_MESSAGE.size :]
        except _DAMAGE as error:
            sentence = f"{self._label} is damaged in its chunk at byte {run.offset}: {error}"
            if damage is None:
                raise BagError(sentence) from None
            damage.append(sentence)

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


def _summary(stream: BinaryIO) -> Summary | None:
    """The summary of a file that has a sound one, with statistics and an index of its messages."""
    size = stream.seek(0, 2)
    stream.seek(max(0, size - _FOOTER.size - len(MAGIC)))
    tail = stream.read()
    if len(tail) != _FOOTER.size + len(MAGIC) or not tail.endswith(MAGIC):
        return None
    _, _, start, _, crc = _FOOTER.unpack_from(tail)
    if not 0 < start < size:
        return None
    if crc:
        stream.seek(start)
        # The checksum covers the summary and the footer up to the checksum itself.
        if zlib.crc32(stream.read(size - start - len(MAGIC) - 4)) != crc:
            return None
    stream.seek(0)
    try:
        summary = SeekingReader(stream).get_summary()
    except _DAMAGE:
        return None
    if summary is None or summary.statistics is None:
        return None
    statistics, chunks = summary.statistics, summary.chunk_indexes
    indexed = len(chunks) == statistics.chunk_count and (chunks or not statistics.message_count)
    within = all(chunk.chunk_start_offset + chunk.chunk_length <= start for chunk in chunks)
    described = summary.channels.keys() >= statistics.channel_message_counts.keys()
    return summary if indexed and within and described else None


def _records(
    stream: BinaryIO, offset: int, length: int, label: str
) -> Iterator[tuple[int, memoryview]]:
    """Opcode and content of a record outside of chunks, or of each that a chunk holds."""
    if length > LARGEST_CHUNK:
        raise BagError(
            f"{label} cannot be read: its chunk at byte {offset} has {length} bytes, and "
            f"{LARGEST_CHUNK} are read at most: record with smaller chunks"
        )
    stream.seek(offset)
    content = memoryview(stream.read(length))
    opcode, declared = _RECORD.unpack_from(content)
    content = content[_RECORD.size :]
    if opcode != Opcode.CHUNK:
        yield opcode, content
        return
    content = _chunk_records(content, whole=len(content) == declared, label=label)
    position = 0
    while position + _RECORD.size <= len(content):
        opcode, declared = _RECORD.unpack_from(content, position)
        begin = position + _RECORD.size
        position = begin + declared
        if position > len(content):
            return
        yield opcode, content[begin:position]


def _chunk_records(content: memoryview, *, whole: bool, label: str) -> memoryview:
    """The records in a chunk, decompressed; of a chunk that is cut, those before the cut."""
    _, _, size, crc, name_length = _CHUNK.unpack_from(content)
    begin = _CHUNK.size + name_length + 8
    if begin > len(content):
        raise ValueError("its header is cut")
    compression = bytes(content[_CHUNK.size : _CHUNK.size + name_length]).decode()
    packed = content[begin:]
    if compression == "":
        records = packed
    elif compression in ("zstd", "lz4"):
        try:
            records = memoryview(unpack(packed, compression, size))
        except BagError as error:
            raise BagError(f"{label} cannot be read: of a chunk {error}") from None
    else:
        raise BagError(f"{label} is compressed with {compression!r}: use zstd, lz4 or none")
    if whole and (len(records) != size or (crc and zlib.crc32(records) != crc)):
        raise ValueError("its checksum does not match")
    return records


def _data_stream(content: memoryview) -> ReadDataStream:
    return ReadDataStream(BytesIO(content))


def _type_name(schema: Schema | None) -> str:
    return normalized_type(schema.name) if schema else ""


def _schema_text(schema: Schema | None) -> str | None:
    if schema is None or schema.encoding != "ros2msg":
        return None
    return schema.data.decode("utf-8", errors="replace")
