"""What can be read of an MCAP file that was cut, damaged, or is still being written.

The records are walked from the start. A record is sound when its checksum holds or, where it has
none, when its fields agree with one another to the last byte; the length of a chunk and of an
attachment is there twice, so one wrong number costs neither. After damage reading goes on at the
next sound chunk or message index, and of a chunk that is cut the leading messages are kept. What is
lost is counted by the message indexes that follow each chunk.

The readers of mcap 1.6 and rosbags 0.11.9 end at the first damage: of 40,400 messages in a file
with one wrong byte they give 19,393 and 19,392, this one 40,397; of the same file cut at three
quarters none, this one 40,293.

The format: https://mcap.dev/spec.
"""

from __future__ import annotations

import contextlib
import re
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from io import BytesIO
from typing import Any, BinaryIO, NamedTuple

import lz4.frame
import zstandard
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from us_sim.recording.topic import Fault

HEADER = struct.Struct("<BQ")  # opcode, length of what follows
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_CHUNK = struct.Struct("<BQQQQII")  # opcode, length, start, end, size, CRC, length of compression
_LENGTH = struct.Struct("<Q")
_INDEX = struct.Struct("<HI")  # channel, length of the entries
_TIME = struct.Struct("<Q8x")  # log time, place in its chunk
_CRC = struct.Struct("<I")
_HEAD = 64  # bytes in which all fields of a chunk are that come before its records
_BLOCK = 1 << 20
_LIKE_A_RECORD = re.compile(rb"(?=[\x06\x07].{4}\0{4})", re.DOTALL)
"""A chunk or a message index of less than 4 GiB may begin there."""
_PLACES_TOLD = 3

DAMAGE = (
    *(McapError, zstandard.ZstdError, struct.error, RuntimeError),  # the last one of lz4
    *(EOFError, OverflowError, ValueError, KeyError, MemoryError),
)
"""Errors that the parsers raise for damaged bytes."""

_KINDS: dict[int, Any] = {
    Opcode.HEADER: records.Header,
    Opcode.SCHEMA: records.Schema,
    Opcode.CHANNEL: records.Channel,
    Opcode.METADATA: records.Metadata,
    Opcode.DATA_END: records.DataEnd,
    Opcode.STATISTICS: records.Statistics,
    Opcode.CHUNK_INDEX: records.ChunkIndex,
    Opcode.ATTACHMENT_INDEX: records.AttachmentIndex,
    Opcode.METADATA_INDEX: records.MetadataIndex,
    Opcode.SUMMARY_OFFSET: records.SummaryOffset,
    Opcode.FOOTER: records.Footer,
}
_AFTER_THE_DATA = {*_KINDS} - {Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA}


class Run(NamedTuple):
    """A stretch of the file that holds messages: a chunk, or a message outside of chunks."""

    start: int  # ns, lowest log time in it
    offset: int  # bytes, of its record's opcode
    end: int  # ns, highest log time in it
    length: int  # bytes of its record
    channels: tuple[int, ...]  # of its messages; none where nobody has looked


class Place(NamedTuple):
    """Where a record is that holds no messages."""

    offset: int  # bytes
    length: int  # bytes
    name: str


class Contents:
    """What a file holds, and where."""

    def __init__(self) -> None:
        self.schemas: dict[int, records.Schema] = {}
        self.channels: dict[int, records.Channel] = {}
        self.counts: Counter[int] = Counter()  # messages by channel
        self.runs: list[Run] = []
        self.attachments: list[Place] = []
        self.notes: list[Place] = []
        self.start: int | None = None  # ns, of the log times
        self.end: int | None = None
        self.faults: list[Fault] = []

    def learn(self, opcode: int, content: memoryview, *, anew: bool = True) -> None:
        """Keep a schema or a channel; if not ``anew``, only where its number is not known."""
        known: dict[int, Any]
        if opcode == Opcode.SCHEMA:
            known = self.schemas
        elif opcode == Opcode.CHANNEL:
            known = self.channels
        else:
            return
        record = parsed(_KINDS[opcode], content)
        if anew or record.id not in known:
            known[record.id] = record

    def add_messages(self, offset: int, length: int, messages: list[tuple[int, int]]) -> None:
        """Count messages, by channel and log time, that a record holds."""
        if not messages:
            return
        times = [time for _, time in messages]
        counts = Counter(channel for channel, _ in messages)
        self.runs.append(Run(min(times), offset, max(times), length, tuple(counts)))
        self.counts += counts
        self.start = min(times) if self.start is None else min(self.start, *times)
        self.end = max(times) if self.end is None else max(self.end, *times)


class _Exact(BytesIO):
    """Bytes of which no more can be read than there are."""

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        if size is not None and len(data) < size:
            raise EOFError("its lengths contradict one another")
        return data


def parsed(kind: Any, content: memoryview) -> Any:
    """The record of a class of `mcap.records` that these bytes are, to the last one.

    Raises:
        DAMAGE: they are none.
    """
    stream = _Exact(content)
    record = kind.read(ReadDataStream(stream))
    if stream.tell() != len(content):
        raise ValueError("its lengths contradict one another")
    return record


def parsed_attachment(content: memoryview) -> records.Attachment:
    """The attachment that these bytes are.

    Raises:
        DAMAGE: they are none, or the checksum does not hold.
    """
    record: records.Attachment = parsed(records.Attachment, content)
    (crc,) = _CRC.unpack_from(content, len(content) - _CRC.size)
    if crc and zlib.crc32(content[: -_CRC.size]) != crc:
        raise ValueError("its checksum does not match")
    return record


def split(content: memoryview) -> Iterator[tuple[int, memoryview, int]]:
    """Opcode, content and end of each whole record."""
    position = 0
    while position + HEADER.size <= len(content):
        opcode, length = HEADER.unpack_from(content, position)
        begin, position = position + HEADER.size, position + HEADER.size + length
        if position > len(content):
            return
        yield opcode, content[begin:position], position


def records_in(record: memoryview) -> list[tuple[int, memoryview]]:
    """Opcode and content of each record in a chunk; of one that is cut, of those before the cut.

    Raises:
        DAMAGE: it is not sound.
    """
    _, length, _, _, size, crc, name = _CHUNK.unpack_from(record)
    begin = _CHUNK.size + name + _LENGTH.size
    (said,) = _LENGTH.unpack_from(record, begin - _LENGTH.size)
    is_cut = len(record) < min(begin + said, HEADER.size + length)
    compression, packed = bytes(record[_CHUNK.size :][:name]), record[begin:]
    if compression == b"zstd" and is_cut:
        content = memoryview(b"".join(unpacked_pieces(BytesIO(packed))))
    elif compression == b"zstd":
        content = memoryview(zstandard.decompress(packed, size))
    elif compression == b"lz4":
        content = memoryview(lz4.frame.LZ4FrameDecompressor().decompress(packed))
    elif compression == b"":
        content = packed
    else:
        raise ValueError(f"it is compressed with {compression.decode()!r}, not zstd or lz4")
    if not is_cut and (zlib.crc32(content) != crc if crc else len(content) != size):
        raise ValueError("its checksum does not match")
    held = list(split(content))
    if not is_cut and len(content) != (held[-1][2] if held else 0):
        raise ValueError("its records break off")
    return [(opcode, inner) for opcode, inner, _ in held]


def unpacked_pieces(packed: BinaryIO) -> Iterator[bytes]:
    """The bytes of zstd frames in pieces; of a frame that is cut, those before the cut."""
    with zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True) as reader:
        while piece := reader.read(_BLOCK):
            yield piece


class _Record(NamedTuple):
    """A sound record."""

    opcode: int
    offset: int  # bytes
    end: int  # bytes
    content: memoryview  # none of a chunk
    held: list[tuple[int, memoryview]]  # the records of a chunk


def _record_at(stream: BinaryIO, offset: int, size: int) -> _Record | None:
    """The sound record that begins there in a file of so many bytes."""
    stream.seek(offset)
    head = stream.read(_HEAD)
    if len(head) < HEADER.size:
        return None
    opcode, length = HEADER.unpack_from(head)
    for end in sorted(_chunk_ends(head)):  # whatever its opcode
        if end <= size - offset:
            stream.seek(offset)
            with contextlib.suppress(*DAMAGE):
                held = records_in(memoryview(stream.read(end)))
                if held or opcode == Opcode.CHUNK:
                    return _Record(Opcode.CHUNK, offset, offset + end, memoryview(b""), held)
    if opcode == Opcode.MESSAGE_INDEX and not _is_index(head, length):
        return None
    for end in _ends(stream, offset, opcode, length):
        if end <= size:
            stream.seek(offset + HEADER.size)
            content = memoryview(stream.read(end - offset - HEADER.size))
            if _is_sound(opcode, content):
                return _Record(opcode, offset, end, content, [])
    return None


def _chunk_ends(head: bytes) -> set[int]:
    """The lengths that a chunk's record may have by the two that its head says; none of others."""
    if len(head) < _CHUNK.size + _LENGTH.size:
        return set()
    opcode, length, _, _, _, crc, name = _CHUNK.unpack_from(head)
    begin = _CHUNK.size + name + _LENGTH.size
    if head[_CHUNK.size :][:name] not in (b"", b"zstd", b"lz4") or begin > len(head):
        return set()
    ends = {begin + _LENGTH.unpack_from(head, begin - _LENGTH.size)[0], HEADER.size + length}
    is_sure = len(ends) == 1 or (crc and opcode == Opcode.CHUNK)
    return {end for end in ends if end >= begin} if is_sure else set()


def _is_index(head: bytes, length: int) -> bool:
    """Whether a message index of that length may begin so."""
    if len(head) < HEADER.size + _INDEX.size:
        return False
    _, entries = _INDEX.unpack_from(head, HEADER.size)
    return entries == length - _INDEX.size and entries % 16 == 0


def _ends(stream: BinaryIO, offset: int, opcode: int, length: int) -> Iterator[int]:
    """Where a record that is no chunk may end."""
    yield offset + HEADER.size + length
    if opcode == Opcode.ATTACHMENT:
        end = offset + HEADER.size + 16
        with contextlib.suppress(struct.error, OverflowError, OSError):
            for form in (_CRC, _CRC, _LENGTH):  # lengths of its name, its kind, its data
                stream.seek(end)
                end += form.size + form.unpack(stream.read(form.size))[0]
            yield end + _CRC.size


def _is_sound(opcode: int, content: memoryview) -> bool:
    """Whether these bytes are a record of that kind, no chunk."""
    if opcode == Opcode.MESSAGE:
        return len(content) >= MESSAGE.size
    try:
        if opcode == Opcode.ATTACHMENT:
            parsed_attachment(content)
        elif opcode != Opcode.MESSAGE_INDEX:
            parsed(_KINDS[opcode], content)
    except DAMAGE:
        return False
    return True


def _next_sound(stream: BinaryIO, offset: int, size: int) -> int | None:
    """Where records are sound again after a damaged one that begins there; None if nowhere.

    Records within chunks do not count: they have no checksum of their own.
    """
    stream.seek(offset)
    head = stream.read(_HEAD)
    if len(head) >= HEADER.size:
        opcode, length = HEADER.unpack_from(head)
        end = offset + HEADER.size + length
        if opcode and (end == size or (end < size and _record_at(stream, end, size))):
            return end
        if opcode == Opcode.ATTACHMENT and min(_ends(stream, offset, opcode, length)) > size:
            return None  # it is cut, and may be an MCAP file itself
        if _is_cut_chunk(head, size - offset):
            return None  # among the pixels of an image are bytes that could be a record
    for begin in range(offset + 1, size, _BLOCK):
        stream.seek(begin)
        block = stream.read(_BLOCK + HEADER.size)
        for match in _LIKE_A_RECORD.finditer(block):
            if _record_at(stream, begin + match.start(), size):
                return begin + match.start()
    return None


def _is_cut_chunk(head: bytes, rest: int) -> bool:
    """Whether a chunk begins so that is longer than the rest of the file, as both lengths say."""
    ends = _chunk_ends(head)
    return head[:1] == bytes([Opcode.CHUNK]) and len(ends) == 1 and min(ends) > rest


def salvage(stream: BinaryIO, label: str) -> Contents:
    """Find all that is sound in a file; ``label`` names it in the faults."""
    size, position = stream.seek(0, 2), len(MCAP0_MAGIC)
    found = Contents()
    gaps: list[tuple[int, int]] = []
    missing: Counter[int] = Counter()
    tables: dict[int, tuple[int, int]] = {}  # of the last chunk: messages, lowest log time
    is_chunked = follows_gap = ended = False
    while not ended and position < size:
        record = _record_at(stream, position, size)
        if record is None or (
            # Messages are in chunks, or all outside of them.
            record.opcode == Opcode.MESSAGE
            and (is_chunked or MESSAGE.unpack_from(record.content)[0] not in found.channels)
        ):
            after = _next_sound(stream, position, size)
            if after is None:
                break
            gaps.append((position, after))
            position, follows_gap = after, True
            continue
        position, length = record.end, record.end - record.offset
        ended = record.opcode in _AFTER_THE_DATA
        if record.opcode == Opcode.CHUNK:
            tables = _take_chunk(found, record.offset, length, record.held)
            is_chunked, follows_gap = True, False
        elif record.opcode == Opcode.MESSAGE_INDEX:
            channel, _ = _INDEX.unpack_from(record.content)
            times = [time for (time,) in _TIME.iter_unpack(record.content[_INDEX.size :])]
            # Of a chunk that was passed over, else of the last one.
            if follows_gap and times and tables.get(channel) != (len(times), min(times)):
                missing[channel] += len(times)
        elif record.opcode == Opcode.MESSAGE:
            channel, _, time, _ = MESSAGE.unpack_from(record.content)
            found.add_messages(record.offset, length, [(channel, time)])
        elif record.opcode == Opcode.ATTACHMENT:
            name = parsed_attachment(record.content).name
            found.attachments.append(Place(record.offset, length, name))
        elif record.opcode == Opcode.METADATA:
            name = parsed(records.Metadata, record.content).name
            found.notes.append(Place(record.offset, length, name))
        else:
            found.learn(record.opcode, record.content)
    if ended:  # a summary whose checksum does not hold may have types that are lost elsewhere
        end = position
        while (record := _record_at(stream, end, size)) is not None:
            found.learn(record.opcode, record.content, anew=False)
            end = record.end
    else:
        stream.seek(position)
        if _is_cut_chunk(stream.read(_HEAD), size - position):
            stream.seek(position)
            with contextlib.suppress(*DAMAGE):
                held = records_in(memoryview(stream.read()))
                _take_chunk(found, position, size - position, held)
    for channel in found.counts.keys() - found.channels.keys():
        missing[channel] += found.counts.pop(channel)  # of a topic whose name is lost
    stream.seek(max(0, size - len(MCAP0_MAGIC)))
    if not (ended and stream.read() == MCAP0_MAGIC):
        seconds = (found.end - found.start) / 1e9 if found.start and found.end else 0.0
        text = (
            f"{label} was not ended properly (it breaks off at byte {position} of {size}): "
            f"{found.counts.total()} messages over {seconds:.1f} s were recovered"
        )
        found.faults.append(Fault(text))
    if gaps or missing:
        places = [f"{first} to {last}" for first, last in gaps[:_PLACES_TOLD]]
        more = f" and {len(gaps) - len(places)} more stretches" if gaps[_PLACES_TOLD:] else ""
        where = f" (bytes {', '.join(places)}{more} cannot be understood)" if gaps else ""
        lost = f"{missing.total()} messages are" if missing else "no message is known to be"
        found.faults.append(Fault(f"{label} is damaged{where}: {lost} lost", missing.total()))
    return found


def _take_chunk(
    found: Contents, offset: int, length: int, held: list[tuple[int, memoryview]]
) -> dict[int, tuple[int, int]]:
    """Keep what a chunk holds; for each channel its messages and their lowest log time."""
    messages: list[tuple[int, int]] = []
    for opcode, content in held:
        if opcode == Opcode.MESSAGE:
            channel, _, time, _ = MESSAGE.unpack_from(content)
            messages.append((channel, time))
        else:
            with contextlib.suppress(*DAMAGE):  # of a chunk without a checksum
                found.learn(opcode, content)
    found.add_messages(offset, length, messages)
    tables: dict[int, tuple[int, int]] = {}
    for channel, time in messages:
        count, lowest = tables.get(channel, (0, time))
        tables[channel] = count + 1, min(lowest, time)
    return tables
