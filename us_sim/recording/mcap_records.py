"""The records of an MCAP file: their places, their soundness, and the contents of chunks.

A record is sound when its checksum holds or, where it has none, when its fields agree with one
another to the last byte. The length of a chunk and of an attachment is there twice, so one wrong
number costs neither.

The format: https://mcap.dev/spec.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from typing import Any, BinaryIO, NamedTuple

import zstandard
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from us_sim.errors import BagError
from us_sim.recording.unpacking import LARGEST_CHUNK, unpack

HEADER = struct.Struct("<BQ")  # opcode, length of what follows
CHUNK = struct.Struct("<BQQQQII")  # opcode, length, start, end, size, CRC, length of compression
LENGTH = struct.Struct("<Q")
_CRC = struct.Struct("<I")
_INDEX = struct.Struct("<HI")  # channel, length of the entries
_TIMES = struct.Struct("<QQ")
_SHORT = struct.Struct("<I")
_COMPRESSIONS = (b"", b"zstd", b"lz4")

DAMAGE = (
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

AFTER_THE_DATA = frozenset(
    (
        *(Opcode.DATA_END, Opcode.STATISTICS, Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX),
        *(Opcode.METADATA_INDEX, Opcode.SUMMARY_OFFSET, Opcode.FOOTER),
    )
)
"""Records that come only after the last message."""

_KINDS: dict[int, Any] = {
    Opcode.HEADER: records.Header,
    Opcode.FOOTER: records.Footer,
    Opcode.SCHEMA: records.Schema,
    Opcode.CHANNEL: records.Channel,
    Opcode.CHUNK_INDEX: records.ChunkIndex,
    Opcode.ATTACHMENT_INDEX: records.AttachmentIndex,
    Opcode.STATISTICS: records.Statistics,
    Opcode.METADATA: records.Metadata,
    Opcode.METADATA_INDEX: records.MetadataIndex,
    Opcode.SUMMARY_OFFSET: records.SummaryOffset,
    Opcode.DATA_END: records.DataEnd,
}

_BLOCK, _OVERLAP = 1 << 20, 64
_LIKE_A_RECORD = re.compile(rb"(?=[\x06\x07\x09\x0c].{4}\0{4})", re.DOTALL)
"""A chunk, a message index, an attachment or metadata of less than 4 GiB may begin there."""


class Chunk(NamedTuple):
    """Where a chunk is, and how it is packed."""

    offset: int  # bytes, of its record's opcode
    packed: int  # bytes, of its records
    end: int  # bytes
    compression: str
    size: int  # bytes of its records when they are unpacked
    is_whole: bool = True  # else the file ends within it


class Record(NamedTuple):
    """A sound record."""

    opcode: int
    offset: int  # bytes
    end: int  # bytes
    content: memoryview  # of a chunk: its records, unpacked
    chunk: Chunk | None = None


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


def record_at(stream: BinaryIO, offset: int, size: int) -> Record | None:
    """The sound record that begins there in a file of so many bytes."""
    stream.seek(offset)
    head = stream.read(_OVERLAP)
    if len(head) < HEADER.size:
        return None
    for chunk in _chunks(offset, head, size):  # whatever its opcode
        try:
            content = _unpacked(stream, chunk)
            *_, end = (0, *(end for _, _, end in _split(content)))
            if end == len(content) and (content or head[0] == Opcode.CHUNK):
                return Record(Opcode.CHUNK, offset, chunk.end, content, chunk)
        except DAMAGE:
            continue
    opcode, length = HEADER.unpack_from(head)
    for end in _ends(stream, offset, opcode, length):
        if end > size or end - offset > LARGEST_CHUNK:
            continue
        stream.seek(offset + HEADER.size)
        content = memoryview(stream.read(end - offset - HEADER.size))
        if _is_sound(opcode, content):
            return Record(opcode, offset, end, content)
    return None


def next_sound(stream: BinaryIO, offset: int, size: int) -> int | None:
    """Where records are sound again after a damaged one that begins there; None if nowhere.

    Records within chunks do not count: they have no checksum of their own.
    """
    stream.seek(offset)
    head = stream.read(HEADER.size)
    if len(head) == HEADER.size:
        opcode, length = HEADER.unpack(head)
        end = offset + HEADER.size + length
        if opcode and (end == size or (end < size and record_at(stream, end, size))):
            return end
        if opcode == Opcode.ATTACHMENT and min(_ends(stream, offset, opcode, length)) > size:
            return None  # it is cut, and may be an MCAP file itself
        if cut_chunk_at(stream, offset, size) is not None:
            return None  # among the pixels of an image are bytes that could be a record
    for begin in range(offset + 1, size, _BLOCK - _OVERLAP):
        stream.seek(begin)
        block = stream.read(_BLOCK)
        for match in _LIKE_A_RECORD.finditer(block):
            at = match.start()
            if _may_be_a_record(block[at : at + _OVERLAP]) and record_at(stream, begin + at, size):
                return begin + at
    return None


def cut_chunk_at(stream: BinaryIO, offset: int, size: int) -> Chunk | None:
    """The chunk that begins there and within which the file ends, as both its lengths say."""
    stream.seek(offset)
    head = stream.read(_OVERLAP)
    if head[:1] != bytes([Opcode.CHUNK]) or len(head) < CHUNK.size + LENGTH.size:
        return None
    _, length, _, _, unpacked, _, name_length = CHUNK.unpack_from(head)
    begin = CHUNK.size + name_length + LENGTH.size
    name = head[CHUNK.size : CHUNK.size + name_length]
    if name not in _COMPRESSIONS or begin > len(head) or offset + HEADER.size + length <= size:
        return None
    if begin + LENGTH.unpack_from(head, begin - LENGTH.size)[0] != HEADER.size + length:
        return None
    return Chunk(offset, offset + begin, size, name.decode(), unpacked, is_whole=False)


def records_in(stream: BinaryIO, chunk: Chunk) -> Iterator[tuple[int, memoryview]]:
    """Opcode and content of each record in a chunk; of one that is cut, of those before the cut.

    Raises:
        DAMAGE: it is not sound.
    """
    content = _unpacked(stream, chunk)
    reached = 0
    for opcode, record, end in _split(content):
        yield opcode, record
        reached = end
    if chunk.is_whole and reached != len(content):
        raise ValueError("its records break off")


def _chunks(offset: int, head: bytes, size: int) -> Iterator[Chunk]:
    """The chunks that may begin there, by the one or the other of the lengths in their head."""
    if len(head) < CHUNK.size + LENGTH.size:
        return
    opcode, length, _, _, unpacked, crc, name_length = CHUNK.unpack_from(head)
    name = head[CHUNK.size : CHUNK.size + name_length]
    begin = CHUNK.size + name_length + LENGTH.size
    if name not in _COMPRESSIONS or begin > len(head):
        return
    (said,) = LENGTH.unpack_from(head, begin - LENGTH.size)
    ends = {begin + said, HEADER.size + length}
    if len(ends) > 1 and not (crc and opcode == Opcode.CHUNK):
        return
    for end in ends:
        if begin <= end <= min(size - offset, LARGEST_CHUNK):
            yield Chunk(offset, offset + begin, offset + end, name.decode(), unpacked)


def _unpacked(stream: BinaryIO, chunk: Chunk) -> memoryview:
    """The bytes of a chunk's records."""
    if not chunk.offset + CHUNK.size < chunk.packed <= chunk.end:
        raise ValueError("its lengths contradict one another")
    if chunk.end - chunk.offset > LARGEST_CHUNK:
        raise ValueError(
            f"it has {chunk.end - chunk.offset} bytes, and {LARGEST_CHUNK} are read at most: "
            f"record with smaller chunks"
        )
    stream.seek(chunk.offset)
    content = memoryview(stream.read(chunk.end - chunk.offset))
    if len(content) < chunk.end - chunk.offset:
        raise ValueError("the file ends before it")
    packed = content[chunk.packed - chunk.offset :]
    if chunk.compression == "":
        unpacked = packed
    elif chunk.compression in ("zstd", "lz4"):
        try:
            unpacked = memoryview(unpack(packed, chunk.compression, chunk.size))
        except BagError as error:
            raise ValueError(str(error)) from None
    else:
        raise ValueError(f"it is compressed with {chunk.compression!r}, not zstd or lz4")
    crc = CHUNK.unpack_from(content)[5]
    holds = zlib.crc32(unpacked) == crc if crc else len(unpacked) == chunk.size
    if chunk.is_whole and not holds:
        raise ValueError("its checksum does not match")
    return unpacked


def _split(content: memoryview) -> Iterator[tuple[int, memoryview, int]]:
    """Opcode, content and end of each whole record."""
    position = 0
    while position + HEADER.size <= len(content):
        opcode, length = HEADER.unpack_from(content, position)
        begin, position = position + HEADER.size, position + HEADER.size + length
        if position > len(content):
            return
        yield opcode, content[begin:position], position


def _ends(stream: BinaryIO, offset: int, opcode: int, length: int) -> Iterator[int]:
    """Where a record that is no chunk may end."""
    yield offset + HEADER.size + length
    if opcode == Opcode.ATTACHMENT:
        end = offset + HEADER.size + 16
        try:
            for form in (_SHORT, _SHORT, LENGTH):  # of its name, its kind, its data
                stream.seek(end)
                end += form.size + form.unpack(stream.read(form.size))[0]
        except (struct.error, OverflowError, OSError):
            return
        yield end + _CRC.size


def _is_sound(opcode: int, content: memoryview) -> bool:
    """Whether these bytes are a record of that kind, no chunk."""
    if opcode == Opcode.MESSAGE:
        return len(content) >= 22  # its fields before the data
    try:
        if opcode == Opcode.MESSAGE_INDEX:
            entries = len(content) - _INDEX.size
            return _INDEX.unpack_from(content)[1] == entries and entries % _TIMES.size == 0
        if opcode == Opcode.ATTACHMENT:
            attachment(content)
            return True
        return opcode in _KINDS and parsed(_KINDS[opcode], content) is not None
    except DAMAGE:
        return False


def attachment(content: memoryview) -> records.Attachment:
    """The attachment that a record holds.

    Raises:
        DAMAGE: it is none, or its checksum does not hold.
    """
    record: records.Attachment = parsed(records.Attachment, content)
    (crc,) = _CRC.unpack_from(content, len(content) - _CRC.size)
    if crc and zlib.crc32(content[: -_CRC.size]) != crc:
        raise ValueError("its checksum does not match")
    return record


def _may_be_a_record(head: bytes) -> bool:
    """Whether these may be a record's first bytes: its lengths agree, as those of few bytes do."""
    try:
        opcode, length = HEADER.unpack_from(head)
        if opcode == Opcode.CHUNK:
            return any(_chunks(0, head, LARGEST_CHUNK))
        if opcode == Opcode.MESSAGE_INDEX:
            entries = _INDEX.unpack_from(head, HEADER.size)[1]
            return 0 < entries == length - _INDEX.size
        name_at = HEADER.size + (16 if opcode == Opcode.ATTACHMENT else 0)
        return bool(_SHORT.unpack_from(head, name_at)[0] < length)
    except struct.error:
        return False
