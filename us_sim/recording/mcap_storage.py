"""Reading one MCAP file: by the index in its summary, or else by a walk through its records.

The records are mcap's. Its ``iter_messages`` is not used: it ends before the end of a file that was
cut, and takes 3.4 times as long as this for small messages.
"""

from __future__ import annotations

import heapq
import os
import struct
import zlib
from collections import Counter
from collections.abc import Collection, Iterator
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
from us_sim.recording.schemas import normalize_type
from us_sim.recording.topic import BagMessage, BagTopic, qos_from_yaml

_HEADER = struct.Struct("<BQ")  # opcode, length of what follows
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_CHUNK = struct.Struct("<QQQII")  # start, end, size, CRC, length of the compression's name
_LENGTH = 8  # bytes
_BESIDES = {bytes([Opcode.ATTACHMENT]), bytes([Opcode.METADATA])}  # first bytes of such records
_LAST = 2**63 - 1  # ns
REMEDY = "`mcap recover` of https://mcap.dev writes what can be read as a file with an index"

_DAMAGE = (
    *(McapError, zstandard.ZstdError, struct.error, RuntimeError),  # the last one of lz4
    *(OverflowError, ValueError, LookupError, MemoryError, OSError),
)
"""Errors that the parsers raise for damaged bytes."""


class _Run(NamedTuple):
    """A stretch of the file that holds messages: a chunk, or a message outside of chunks."""

    start: int  # ns, lowest log time in it
    offset: int  # bytes, of its record's opcode
    end: int  # ns, highest log time in it
    length: int  # bytes of its record
    channels: tuple[int, ...]  # of its messages; none where the index does not say


_Ordered = tuple[int, int, int, BagMessage]  # log time, offset of the run, place in it, message


class McapStorage:
    """One MCAP file as a Storage.

    Raises:
        BagError: it is damaged, or the quality of service of a topic cannot be understood.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.fault = ""
        self.attachments: list[Attachment] = []
        self.notes: list[Metadata] = []
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._counts: Counter[int] = Counter()  # messages by channel
        self._runs: list[_Run] = []
        with path.open("rb") as stream:
            if not self._read_index(stream):
                self._walk(stream)
        self._runs.sort()
        self.start = min((run.start for run in self._runs), default=None)
        self.end = max((run.end for run in self._runs), default=None)
        self.topics = [self._topic(id, channel) for id, channel in self._channels.items()]

    def read_messages(
        self, topics: Collection[str], damage: list[str] | None, since: int | None
    ) -> Iterator[BagMessage]:
        """Yield the messages of these topics, since a log time (ns), in the order of log times.

        Raises:
            BagError: a chunk is damaged, and there is no ``damage`` that takes such sentences.
        """
        wanted = {
            id: (channel.topic, _type_name(self._schemas.get(channel.schema_id)))
            for id, channel in self._channels.items()
            if channel.topic in topics
        }
        broken = ""
        # Chunks overlap in time; a message leaves the heap when no later chunk can precede it.
        # Of messages with the same log time the one that is earlier in the file comes first.
        pending: list[_Ordered] = []
        with self._path.open("rb") as stream:
            for run in self._runs:
                is_early = since is not None and run.end < since
                if is_early or (run.channels and wanted.keys().isdisjoint(run.channels)):
                    continue
                while pending and pending[0][:2] < (run.start, run.offset):
                    yield heapq.heappop(pending)[-1]
                try:
                    for each in _messages(stream, run, wanted):
                        if since is None or each[0] >= since:
                            heapq.heappush(pending, each)
                except _DAMAGE as error:
                    broken = self._describe_damage(f"chunk at byte {run.offset}", error)
                    if damage is None:
                        break
                    damage.append(broken)
        while pending:
            yield heapq.heappop(pending)[-1]
        if broken and damage is None:
            raise BagError(broken)

    def _describe_damage(self, part: str, error: Exception) -> str:
        return f"{self._path} is damaged in its {part}: {error}; {REMEDY}"

    def _read_index(self, stream: BinaryIO) -> bool:
        """Read the contents by the index; return False where there is no sound one of all."""
        try:
            summary = make_reader(stream).get_summary()
        except _DAMAGE:
            return False
        if summary is None or summary.statistics is None:
            return False
        said = summary.statistics
        besides: list[Any] = [*summary.attachment_indexes, *summary.metadata_indexes]
        records = {each.offset: _record_at(stream, each.offset, each.length) for each in besides}
        if (
            len(summary.chunk_indexes) != said.chunk_count
            or (said.message_count and not said.chunk_count)
            or not summary.channels.keys() >= said.channel_message_counts.keys()
            or not {record[:1] for record in records.values()} <= _BESIDES
        ):
            return False
        self._schemas, self._channels = summary.schemas, summary.channels
        self._counts.update(said.channel_message_counts)
        for each in summary.chunk_indexes:
            times = each.message_start_time, each.message_end_time
            channels = tuple(each.message_index_offsets)
            run = _Run(times[0], each.chunk_start_offset, times[1], each.chunk_length, channels)
            self._runs.append(run)
        for offset, record in records.items():
            try:
                self._add(offset, record)
            except _DAMAGE as error:
                self.fault = self._describe_damage(f"record at byte {offset}", error)
        return True

    def _walk(self, stream: BinaryIO) -> None:
        """Find the contents of a file without an index, up to where it was cut."""
        position, is_ended, why = len(MCAP0_MAGIC), False, ""
        size = stream.seek(-len(MCAP0_MAGIC), 2) + len(MCAP0_MAGIC)
        has_magic = stream.read() == MCAP0_MAGIC
        while position + _HEADER.size <= size and not is_ended:
            opcode, length = _HEADER.unpack(_record_at(stream, position, _HEADER.size))
            end = position + _HEADER.size + length
            if end > size or not opcode:  # zeros are what a power cut leaves
                break
            is_ended = opcode == Opcode.DATA_END
            try:
                self._add(position, _record_at(stream, position, end - position))
            except _DAMAGE as error:
                why = f", and its record at byte {position} is damaged: {error}"
            position = end
        if why or not (is_ended and has_magic):
            times = [time for run in self._runs for time in (run.start, run.end)] or [0]
            self.fault = (
                f"{self._path} was not ended properly (it breaks off at byte {position} of "
                f"{size}{why}): {self._counts.total()} messages over "
                f"{(max(times) - min(times)) / 1e9:.1f} s were recovered; {REMEDY}"
            )

    def _add(self, offset: int, record: bytes) -> None:
        """Note what a record holds.

        Raises:
            _DAMAGE: it is not sound.
        """
        heads = []
        for opcode, content in [*_records_in(record)]:
            if opcode == Opcode.MESSAGE:
                heads.append(_MESSAGE.unpack_from(content))
            elif opcode == Opcode.SCHEMA:
                schema = _parse(Schema, content)
                self._schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = _parse(Channel, content)
                self._channels[channel.id] = channel
            elif opcode == Opcode.METADATA:
                self.notes.append(_parse(Metadata, content))
            elif opcode == Opcode.ATTACHMENT:
                self.attachments.append(_parse(Attachment, content))
        if heads:
            times = [time for _, _, time, _ in heads]
            counts = Counter(channel for channel, *_ in heads)
            self._runs.append(_Run(min(times), offset, max(times), len(record), tuple(counts)))
            self._counts += counts

    def _topic(self, id: int, channel: Channel) -> BagTopic:
        schema = self._schemas.get(channel.schema_id)
        is_text = schema is not None and schema.encoding == "ros2msg"
        qos = channel.metadata.get("offered_qos_profiles")
        return BagTopic(
            name=channel.topic,
            type_name=_type_name(schema),
            message_count=self._counts[id],
            qos=qos_from_yaml(qos, f"{self._path}, {channel.topic}"),
            type_hash=channel.metadata.get("topic_type_hash", ""),
            encoding=channel.message_encoding,
            schema=schema.data.decode(errors="replace") if schema and is_text else None,
        )


def _record_at(stream: BinaryIO, offset: int, length: int) -> bytes:
    """Read a record; less of it where the file ends before."""
    size = os.fstat(stream.fileno()).st_size
    stream.seek(min(offset, size))
    return stream.read(min(length, size))


def _parse(kind: Any, content: memoryview) -> Any:
    return kind.read(ReadDataStream(BytesIO(content)))


def _records_in(record: bytes) -> Iterator[tuple[int, memoryview]]:
    """Yield opcode and content of each record in a chunk; of another record, its own.

    Raises:
        _DAMAGE: it is not sound.
    """
    content = memoryview(record)[_HEADER.size :]
    if record[:1] != bytes([Opcode.CHUNK]):
        yield record[0], content
        return
    *_, crc, name = _CHUNK.unpack_from(content)
    held, position = content[_CHUNK.size + name + _LENGTH :], 0
    if name:  # of a compression
        stream, size = get_chunk_data_stream(_parse(Chunk, content), validate_crc=True)
        held = memoryview(stream.read(size))
    elif crc and zlib.crc32(held) != crc:  # here, since mcap copies what is not compressed
        raise ValueError("its checksum does not match")
    while position < len(held):
        opcode, length = _HEADER.unpack_from(held, position)
        position += _HEADER.size + length
        if position > len(held):
            raise ValueError("its records break off")
        yield opcode, held[position - length : position]


def _messages(
    stream: BinaryIO, run: _Run, wanted: dict[int, tuple[str, str]]
) -> Iterator[_Ordered]:
    """Yield the messages of a run on channels of which name and type are given.

    Raises:
        _DAMAGE: it is not sound.
    """
    record = _record_at(stream, run.offset, run.length)
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
    return normalize_type(schema.name) if schema else ""
