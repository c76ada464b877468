"""What can be read of an MCAP file that was cut, damaged, or is still being written.

The records are walked from the start by their lengths. A damaged chunk is left out and counted by
the message indexes that follow it; of a chunk that is cut the leading messages are kept. Where a
length is damaged, reading goes on at the next sound chunk or message index.

The readers of mcap 1.6 and rosbags 0.11.9 end at the first damage.

The format: https://mcap.dev/spec.
"""

from __future__ import annotations

import contextlib
import mmap
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
_ENTRY = 16  # bytes of an entry of a message index
_CRC = struct.Struct("<I")
_BLOCK = 1 << 20
_LIKE_A_RECORD = re.compile(rb"(?=[\x06\x07].{4}\0{4})", re.DOTALL)
"""A chunk or a message index of less than 4 GiB may begin there."""
_PLACES_TOLD = 3

DAMAGE = (
    *(McapError, zstandard.ZstdError, struct.error, RuntimeError),  # the last one of lz4
    *(EOFError, OverflowError, ValueError, KeyError, MemoryError),
)
"""Errors that the parsers raise for damaged bytes."""


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
            record, known = parsed(records.Schema, content), self.schemas
        elif opcode == Opcode.CHANNEL:
            record, known = parsed(records.Channel, content), self.channels
        else:
            return
        if anew or record.id not in known:
            known[record.id] = record

    def take(self, offset: int, record: memoryview) -> None:
        """Note what a record holds.

        Raises:
            DAMAGE: it is not sound.
        """
        opcode, content = Opcode(record[0]), record[HEADER.size :]
        place = offset, len(record)
        if opcode == Opcode.CHUNK:
            held = records_in(record)
            for inner, each in held:
                self.learn(inner, each)
            self.add_messages(*place, [each for inner, each in held if inner == Opcode.MESSAGE])
        elif opcode == Opcode.MESSAGE:
            if MESSAGE.unpack_from(content)[0] not in self.channels:
                raise ValueError("it is of a channel that nobody knows")
            self.add_messages(*place, [content])
        elif opcode == Opcode.ATTACHMENT:
            self.attachments.append(Place(*place, parsed_attachment(content).name))
        elif opcode == Opcode.METADATA:
            self.notes.append(Place(*place, parsed(records.Metadata, content).name))
        else:
            self.learn(opcode, content)

    def add_messages(self, offset: int, length: int, messages: list[memoryview]) -> None:
        """Count messages that a record holds."""
        if not messages:
            return
        heads = [MESSAGE.unpack_from(message) for message in messages]
        times = [time for _, _, time, _ in heads]
        counts = Counter(channel for channel, *_ in heads)
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


def _is_chunk(record: memoryview) -> bool:
    """Tell whether a chunk begins so, whose two lengths agree; it may be cut."""
    with contextlib.suppress(struct.error):
        opcode, length, *_, name = _CHUNK.unpack_from(record)
        begin = _CHUNK.size + name + _LENGTH.size
        (said,) = _LENGTH.unpack_from(record, begin - _LENGTH.size)
        return bool(opcode == Opcode.CHUNK and begin + said == HEADER.size + length)
    return False


def _is_sound(content: memoryview, offset: int) -> bool:
    """Tell whether a whole chunk or message index begins there."""
    record = content[offset:]
    if _is_chunk(record):
        with contextlib.suppress(*DAMAGE):
            end = HEADER.size + HEADER.unpack_from(record)[1]
            return end <= len(record) and bool(records_in(record[:end]))
    with contextlib.suppress(struct.error):
        opcode, length = HEADER.unpack_from(record)
        _, entries = _INDEX.unpack_from(record, HEADER.size)
        is_index = opcode == Opcode.MESSAGE_INDEX and entries == length - _INDEX.size
        return is_index and entries % _ENTRY == 0 and HEADER.size + length <= len(record)
    return False


def _after_damage(content: memoryview, offset: int) -> int:
    """Find the place at which records go on after a damaged one; the end if nowhere."""
    opcode, length = HEADER.unpack_from(content, offset)
    end, size = offset + HEADER.size + length, len(content)
    if end == size or (end + HEADER.size <= size and 0 < content[end] <= max(Opcode)):
        return int(end)
    if opcode == Opcode.ATTACHMENT:
        return size  # it is cut, and may be an MCAP file itself
    found = _LIKE_A_RECORD.finditer(content, offset + 1)
    return next((m.start() for m in found if _is_sound(content, m.start())), size)


def salvage(stream: BinaryIO, label: str) -> Contents:
    """Find all that is sound in a file; ``label`` names it in the faults."""
    content = memoryview(mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ))
    size, position, opcode = len(content), len(MCAP0_MAGIC), 0
    found, gaps, missing = Contents(), list[tuple[int, int]](), Counter[int]()
    lost_chunk = is_ended = False
    while opcode != Opcode.FOOTER and position + HEADER.size <= size:
        opcode, length = HEADER.unpack_from(content, position)
        end = position + HEADER.size + length
        record = content[position:end]
        if end > size and _is_chunk(record):
            with contextlib.suppress(*DAMAGE):
                found.take(position, record)
            break
        try:
            if end > size:
                raise EOFError
            is_ended = is_ended or opcode == Opcode.DATA_END
            if is_ended:  # types in the summary may be lost elsewhere
                found.learn(opcode, record[HEADER.size :], anew=False)
            elif opcode == Opcode.MESSAGE_INDEX and lost_chunk:
                channel, entries = _INDEX.unpack_from(record, HEADER.size)
                missing[channel] += entries // _ENTRY
            else:
                found.take(position, record)
                lost_chunk = lost_chunk and opcode != Opcode.CHUNK
            position = end
        except DAMAGE:
            after = _after_damage(content, position)
            if after == size:
                break
            gaps.append((position, after))
            lost_chunk = lost_chunk or opcode == Opcode.CHUNK or opcode not in [*Opcode]
            position = after
    for channel in found.counts.keys() - found.channels.keys():
        missing[channel] += found.counts.pop(channel)  # of a topic whose name is lost
    if not (is_ended and content[-len(MCAP0_MAGIC) :] == MCAP0_MAGIC):
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
