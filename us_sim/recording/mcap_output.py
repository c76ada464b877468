"""One MCAP file while it is written: chunks, and an index of them at the end.

A write that fails takes back what it began, so the file holds whole records at every moment, and
its index can still be written where the disk is full: in the room of the last chunks, if need be.
That, and the copies of each message that it saves, is why this is not ``mcap.writer.Writer``; the
records themselves are those of the ``mcap`` package.

The format: https://mcap.dev/spec.
"""

from __future__ import annotations

import contextlib
import os
import struct
import zlib
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

from us_sim.recording.mcap_records import CHUNK, LENGTH

_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log and publish time
_FOOTER = struct.Struct("<BQQQ")  # opcode, length, start of the summary, of its offsets

_COMPRESS: dict[str, Callable[[bytes], bytes]] = {"": bytes, "zstd": zstandard.compress}

_COUNT = struct.Struct("<HI")  # channel, messages
_PLACE = struct.Struct("<25xQQI")  # likewise: where it begins, its length, that of its offsets
_SPAN = struct.Struct("<9xQQQ")  # of a chunk's index record: start, end, where the chunk begins


@dataclass(frozen=True, slots=True)
class _WrittenChunk:
    """A chunk in the file; there are thirty a second, so little is kept of each."""

    index: bytes  # the record
    counts: bytes  # `_COUNT` of each channel

    @property
    def span(self) -> tuple[int, int, int]:
        """Lowest and highest log time, ns, and where in the file it begins."""
        first, last, begin = _SPAN.unpack_from(self.index)
        return first, last, begin

    @property
    def end(self) -> int:
        """Where it ends, with the tables of its messages."""
        begin, length, offsets = _PLACE.unpack_from(self.index)
        (tables,) = LENGTH.unpack_from(self.index, _PLACE.size + offsets)
        return int(begin + length + tables)


class Place(Enum):
    """Where a file is that is being written."""

    HERE = "where it was made"
    MOVED = "somewhere else"
    REMOVED = "nowhere"
    CUT = "shorter than it was written"


class McapOutput:
    """A new MCAP file of ROS 2 messages.

    Args:
        path: a file that is not there yet.
        library: the name of the writing program.
        compression: of the chunks: ``""`` or ``"zstd"``.
        chunk_size: bytes after which a chunk is ended.

    Raises:
        FileExistsError: there is such a file.
        OSError: it cannot be made.
    """

    def __init__(self, path: Path, library: str, *, compression: str, chunk_size: int) -> None:
        self.path = path
        self.counts: Counter[str] = Counter()  # messages by topic, of the chunk in progress too
        self.dropped: Counter[str] = Counter()  # messages that were in `counts` and are not now
        self.start: int | None = None  # ns, lowest log time
        self.end: int | None = None  # ns, highest log time
        self._compression = compression
        self._chunk_size = chunk_size
        self._schemas: dict[str, Schema] = {}  # by type
        self._channels: dict[str, Channel] = {}  # by topic
        self._declared: set[str] = set()  # topics whose channel's record is in the file
        self._chunks: list[_WrittenChunk] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._begin_chunk()
        self._begin = [MCAP0_MAGIC, _bytes_of(Header("ros2", library))]
        self._size = 0  # bytes of whole records in the file
        self._was_cut = False
        self._file = path.open("xb", buffering=0)
        self._tells_place = self._is_at_path  # some network's folders give no lasting numbers
        try:
            self._append(self._begin)
        except OSError:
            self._file.close()
            with contextlib.suppress(OSError):
                path.unlink()
            raise

    @property
    def is_finished(self) -> bool:
        """Whether the file has been closed."""
        return self._file.closed

    @property
    def place(self) -> Place:
        """Whether somebody else has taken the file away, or a part of it, since it was made."""
        if not self._tells_place or self._is_at_path:
            is_short = os.fstat(self._file.fileno()).st_size < self._size
            return Place.CUT if self._was_cut or is_short else Place.HERE
        return Place.MOVED if os.fstat(self._file.fileno()).st_nlink else Place.REMOVED

    @property
    def _is_at_path(self) -> bool:
        try:
            return os.path.samestat(os.fstat(self._file.fileno()), os.stat(self.path))
        except OSError:
            return False

    @property
    def size(self) -> int:
        """Bytes of the file, with those of the chunk in progress."""
        return self._size + self._pending

    @property
    def message_count(self) -> int:
        """Messages in the file and in the chunk in progress."""
        return self.counts.total()

    def add_topic(
        self, topic: str, type_name: str, definition: str | None, metadata: dict[str, str]
    ) -> None:
        """Make a topic known, with the definition of its type; None says that there is none."""
        schemas, channels = self._schemas, self._channels
        if type_name not in schemas:
            encoding = "" if definition is None else "ros2msg"
            data = (definition or "").encode()
            schemas[type_name] = Schema(
                id=len(schemas) + 1, data=data, encoding=encoding, name=type_name
            )
        channels[topic] = Channel(
            id=len(channels) + 1,
            topic=topic,
            message_encoding="cdr",
            metadata=metadata,
            schema_id=schemas[type_name].id,
        )

    def add_message(
        self, topic: str, log_time: int, publish_time: int, sequence: int, data: bytes
    ) -> None:
        """A message in the chunk in progress, which is written when it is large enough.

        Raises:
            OSError: the chunk cannot be written; its messages are dropped.
        """
        channel = self._channels[topic]
        if topic not in self._declared and topic not in self._declared_here:
            self._put(self._types_of(topic))
            self._declared_here.add(topic)
        header = _MESSAGE.pack(
            Opcode.MESSAGE, 22 + len(data), channel.id, sequence, log_time, publish_time
        )
        self._index[topic].append((log_time, self._pending))
        self._put(header)
        self._put(data)
        self.counts[topic] += 1
        if self.start is None or log_time < self.start:
            self.start = log_time
        if self.end is None or log_time > self.end:
            self.end = log_time
        if self._pending > self._chunk_size:
            self.end_chunk()

    def end_chunk(self) -> None:
        """Write the chunk in progress, if there are messages in it.

        Raises:
            OSError: it cannot be written; its messages are dropped.
        """
        if not self._index:
            return
        records, index = b"".join(self._parts), self._index
        counts = Counter({topic: len(entries) for topic, entries in index.items()})
        self._begin_chunk()
        times = [time for entries in index.values() for time, _ in entries]
        first, last = min(times), max(times)
        packed = _COMPRESS[self._compression](records)
        name = self._compression.encode()
        header = CHUNK.pack(
            *(Opcode.CHUNK, CHUNK.size - 9 + len(name) + 8 + len(packed)),
            *(first, last, len(records), zlib.crc32(records), len(name)),
        )
        header += name + LENGTH.pack(len(packed))
        tables = {}
        for topic, entries in index.items():
            channel = self._channels[topic].id
            tables[channel] = _bytes_of(MessageIndex(channel_id=channel, records=entries))
        try:
            self._notice_cut()
            # Types and topics are there twice: one damaged chunk does not make later ones
            # unreadable.
            new = [topic for topic in index if topic not in self._declared]
            types = b"".join(map(self._types_of, new))
            start = self._size + len(types)
            self._append([types, header, packed, *tables.values()])
        except OSError:
            self._drop(counts)
            raise
        offsets, position = {}, start + len(header) + len(packed)
        for channel, table in tables.items():
            offsets[channel] = position
            position += len(table)
        self._declared.update(new)
        self.start = first if self.start is None else min(first, self.start)
        self.end = last if self.end is None else max(last, self.end)
        written = ChunkIndex(
            message_start_time=first,
            message_end_time=last,
            chunk_start_offset=start,
            chunk_length=len(header) + len(packed),
            message_index_offsets=offsets,
            message_index_length=sum(map(len, tables.values())),
            compression=self._compression,
            compressed_size=len(packed),
            uncompressed_size=len(records),
        )
        packed_counts = [_COUNT.pack(self._channels[t].id, n) for t, n in counts.items()]
        self._chunks.append(_WrittenChunk(_bytes_of(written), b"".join(packed_counts)))

    def add_metadata(self, name: str, values: dict[str, str]) -> None:
        """A record of texts by their names.

        Raises:
            OSError: it cannot be written; the file is as before.
        """
        self._notice_cut()
        record = _bytes_of(Metadata(name=name, metadata=values))
        index = MetadataIndex(offset=self._size, length=len(record), name=name)
        self._append([record])
        self._metadata.append(index)

    def add_attachment(self, name: str, media_type: str, data: bytes, time: int) -> None:
        """A file within the file; ``time`` in ns since the epoch.

        Raises:
            OSError: it cannot be written; the file is as before.
        """
        self._notice_cut()
        attachment = Attachment(
            create_time=time, log_time=time, name=name, media_type=media_type, data=data
        )
        record = _bytes_of(attachment)
        index = AttachmentIndex(
            offset=self._size,
            length=len(record),
            log_time=time,
            create_time=time,
            data_size=len(data),
            name=name,
            media_type=media_type,
        )
        self._append([record])
        self._attachments.append(index)

    def finish(self) -> None:
        """Write the chunk in progress and the index, and close the file.

        Where there is no room for the index, the last chunks make room for it.

        Raises:
            OSError: not even that helps; the file is closed, and can be read without an index.
        """
        with contextlib.closing(self._file):
            with contextlib.suppress(OSError):
                self.end_chunk()
            while True:
                try:
                    self._notice_cut()
                    self._append(self._summary())
                    self._file.truncate(self._size)  # cut off bytes that another process has added
                except OSError:
                    if not self._chunks:
                        raise
                    self._drop_last_chunk()
                else:
                    return

    def _begin_chunk(self) -> None:
        self._parts: list[bytes] = []
        self._pending = 0  # bytes
        self._index: defaultdict[str, list[tuple[int, int]]] = defaultdict(list)
        self._declared_here: set[str] = set()

    def _put(self, data: bytes) -> None:
        self._parts.append(data)
        self._pending += len(data)

    def _types_of(self, topic: str) -> bytes:
        """The records of a topic's type and channel."""
        channel = self._channels[topic]
        schema = next(each for each in self._schemas.values() if each.id == channel.schema_id)
        return _bytes_of(schema) + _bytes_of(channel)

    def _notice_cut(self) -> None:
        """Where another process has cut the file: go on after the last record that is whole."""
        size = os.fstat(self._file.fileno()).st_size
        if size >= self._size:
            return
        self._was_cut = True
        kept = [chunk for chunk in self._chunks if chunk.end <= size]
        lost, self._chunks = self._chunks[len(kept) :], kept
        self._attachments = [e for e in self._attachments if e.offset + e.length <= size]
        self._metadata = [e for e in self._metadata if e.offset + e.length <= size]
        self._declared.clear()
        ends = [chunk.end for chunk in kept]
        ends += [each.offset + each.length for each in self._attachments]
        ends += [each.offset + each.length for each in self._metadata]
        self._cut(max(ends, default=0))
        self._drop(sum(map(self._counts_of, lost), Counter()))
        if not self._size:
            self._append(self._begin)

    def _append(self, parts: Iterable[bytes]) -> None:
        """Write at the end, all or nothing."""
        size = self._size
        try:
            for part in parts:
                rest = memoryview(part)
                while rest:
                    count = self._file.write(rest) or 0
                    rest = rest[count:]
                size += len(part)
        except OSError:
            self._cut(self._size)
            raise
        self._size = size

    def _cut(self, size: int) -> None:
        self._size = size
        with contextlib.suppress(OSError):
            self._file.truncate(size)
        with contextlib.suppress(OSError):
            self._file.seek(size)

    def _drop(self, counts: Counter[str]) -> None:
        """Forget messages that are not in the file, while no chunk is in progress."""
        self.counts -= counts
        self.dropped += counts
        spans = [chunk.span for chunk in self._chunks]
        self.start = min((first for first, _, _ in spans), default=None)
        self.end = max((last for _, last, _ in spans), default=None)

    def _drop_last_chunk(self) -> None:
        """Take back the last chunk and everything after it."""
        chunk = self._chunks.pop()
        self._cut(chunk.span[2])
        self._attachments = [each for each in self._attachments if each.offset < self._size]
        self._metadata = [each for each in self._metadata if each.offset < self._size]
        self._drop(self._counts_of(chunk))

    def _counts_of(self, chunk: _WrittenChunk) -> Counter[str]:
        """Messages of a chunk by topic."""
        topics = {channel.id: topic for topic, channel in self._channels.items()}
        return Counter({topics[id]: n for id, n in _COUNT.iter_unpack(chunk.counts)})

    def _summary(self) -> list[bytes]:
        """The records after the messages: summary, footer and magic."""
        data_end = _bytes_of(DataEnd(0))
        start = self._size + len(data_end)
        groups: list[tuple[Opcode, Iterable[bytes]]] = [
            (Opcode.SCHEMA, map(_bytes_of, self._schemas.values())),
            (Opcode.CHANNEL, map(_bytes_of, self._channels.values())),
            (Opcode.STATISTICS, [_bytes_of(self._statistics())]),
            (Opcode.CHUNK_INDEX, (chunk.index for chunk in self._chunks)),
            (Opcode.ATTACHMENT_INDEX, map(_bytes_of, self._attachments)),
            (Opcode.METADATA_INDEX, map(_bytes_of, self._metadata)),
        ]
        parts, offsets, position = [], [], start
        for opcode, records in groups:
            part = b"".join(records)
            if part:
                offsets.append(_bytes_of(SummaryOffset(opcode, position, len(part))))
            parts.append(part)
            position += len(part)
        offsets_start = position
        content = b"".join(parts + offsets)
        # The checksum covers the summary and the footer up to the checksum itself.
        footer = _FOOTER.pack(Opcode.FOOTER, 20, start, offsets_start)
        crc = zlib.crc32(footer, zlib.crc32(content))
        return [data_end, content, _bytes_of(Footer(start, offsets_start, crc)), MCAP0_MAGIC]

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts={
                self._channels[topic].id: count for topic, count in self.counts.items()
            },
            chunk_count=len(self._chunks),
            message_count=self.message_count,
            message_end_time=self.end or 0,
            message_start_time=self.start or 0,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )


def _bytes_of(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    content: bytes = builder.end()
    return content
