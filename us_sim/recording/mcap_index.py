"""The index of an MCAP file as arrays: where messages of which time and channel are.

Two hours of a session are 200,000 chunks, whose records ``mcap`` parses in 2.7 s; this takes 0.3 s.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Sequence
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Channel, MetadataIndex, Schema, Statistics
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from us_sim.recording.mcap_records import DAMAGE, HEADER, Chunk, parsed

_FOOTER = struct.Struct("<BQQQI")  # opcode, length, start of the summary and its offsets, CRC
_TIMES = 4  # numbers of a chunk's index before its table: start, end, offset, length
_ENTRY = 10  # bytes of the table: channel and the place of its own index
_MOST_NAMES = 16  # bytes of a compression's name


class Run(NamedTuple):
    """A stretch of the file that holds messages: a chunk, or a message outside of chunks."""

    start: int  # ns, lowest log time in it
    offset: int  # bytes, of its first record's opcode
    end: int  # ns, highest log time in it
    chunk: Chunk | None


class Runs:
    """All runs of a file, by their lowest log times.

    Args:
        times: (K, 3) lowest log time (ns), place in the file (bytes) and highest log time (ns).
        chunks: (K, 3) place of the packed records, end, and unpacked size, bytes; or the chunks.
        compression: of all chunks, where they are places.
        held: (N, 2) number of a run, and a channel of which it holds messages.
    """

    def __init__(
        self,
        times: NDArray[np.uint64],
        chunks: NDArray[np.uint64] | Sequence[Chunk | None],
        compression: str = "",
        held: NDArray[np.int64] | None = None,
    ) -> None:
        self._order = np.lexsort((times[:, 1], times[:, 0]))
        self._times, self._chunks, self._compression = times, chunks, compression
        self._ends = times[self._order, 2]
        self._starts = times[self._order, 0]
        place = np.empty(len(times), np.int64)
        place[self._order] = np.arange(len(times))
        pairs = np.empty((0, 2), np.int64) if held is None else held
        self._held = place[pairs[:, 0]], pairs[:, 1]

    def __len__(self) -> int:
        return len(self._times)

    def __getitem__(self, number: int) -> Run:
        k = self._order[number]
        start, offset, end = self._times[k].tolist()
        chunk = self._chunks[k]
        if isinstance(chunk, np.ndarray):
            packed, after, size = chunk.tolist()
            return Run(start, offset, end, Chunk(offset, packed, after, self._compression, size))
        return Run(start, offset, end, chunk)

    def since(self, time: int | None) -> Iterator[Run]:
        """Those that may hold messages of that time (ns) or later, or all."""
        late = np.arange(len(self)) if time is None else np.flatnonzero(self._ends >= time)
        return (self[int(k)] for k in late)

    def holding(self, channel: int, before: int) -> list[int]:
        """Numbers of runs that hold a channel and begin before a time (ns), latest end first."""
        numbers, channels = self._held
        held = numbers[channels == channel]
        held = held[self._starts[held] < before]
        chosen: list[int] = held[np.argsort(self._ends[held], kind="stable")[::-1]].tolist()
        return chosen


class Index(NamedTuple):
    """The summary of a whole file."""

    statistics: Statistics
    schemas: dict[int, Schema]
    channels: dict[int, Channel]
    attachments: list[AttachmentIndex]
    metadata: list[MetadataIndex]
    runs: Runs


def read_index(stream: BinaryIO) -> Index | None:
    """The index of a file that has a sound one, with statistics and every chunk."""
    size = stream.seek(0, 2)
    stream.seek(max(0, size - _FOOTER.size - len(MCAP0_MAGIC)))
    tail = stream.read()
    if len(tail) != _FOOTER.size + len(MCAP0_MAGIC) or not tail.endswith(MCAP0_MAGIC):
        return None
    opcode, _, start, _, crc = _FOOTER.unpack_from(tail)
    if opcode != Opcode.FOOTER or not 0 < start < size:
        return None
    stream.seek(start)
    content = stream.read(size - start - len(tail))
    # The checksum covers the summary and the footer up to the checksum itself.
    if crc and zlib.crc32(tail[: _FOOTER.size - 4], zlib.crc32(content)) != crc:
        return None
    try:
        index = _parsed(memoryview(content))
    except (*DAMAGE, IndexError):
        return None
    if index is None:
        return None
    statistics, runs = index.statistics, index.runs
    indexed = len(runs) == statistics.chunk_count and (len(runs) or not statistics.message_count)
    within = all(run.chunk is not None and run.chunk.end <= start for run in _furthest(runs))
    described = index.channels.keys() >= statistics.channel_message_counts.keys()
    return index if indexed and within and described else None


def _furthest(runs: Runs) -> list[Run]:
    """The run whose chunk ends last."""
    ends = runs._chunks[:, 1] if isinstance(runs._chunks, np.ndarray) else np.empty(0)
    if not len(ends):
        return []
    place = int(np.argmax(ends))
    return [runs[int(np.flatnonzero(runs._order == place)[0])]]


def _parsed(content: memoryview) -> Index | None:
    kinds: dict[int, Any] = {
        Opcode.SCHEMA: Schema,
        Opcode.CHANNEL: Channel,
        Opcode.STATISTICS: Statistics,
        Opcode.ATTACHMENT_INDEX: AttachmentIndex,
        Opcode.METADATA_INDEX: MetadataIndex,
    }
    found: dict[int, list[Any]] = {opcode: [] for opcode in kinds}
    chunks: list[tuple[int, int]] = []  # where the records of chunks begin and end
    position = 0
    while position < len(content):
        opcode, length = HEADER.unpack_from(content, position)
        begin, position = position + HEADER.size, position + HEADER.size + length
        if position > len(content):
            raise ValueError("a record breaks off")
        if opcode == Opcode.CHUNK_INDEX:
            chunks.append((begin, position))
        elif opcode in kinds:
            found[opcode].append(parsed(kinds[opcode], content[begin:position]))
    if not found[Opcode.STATISTICS]:
        return None
    return Index(
        found[Opcode.STATISTICS][-1],
        {schema.id: schema for schema in found[Opcode.SCHEMA]},
        {channel.id: channel for channel in found[Opcode.CHANNEL]},
        found[Opcode.ATTACHMENT_INDEX],
        found[Opcode.METADATA_INDEX],
        _runs(np.frombuffer(content, np.uint8), np.array(chunks, np.int64).reshape(-1, 2)),
    )


def _runs(content: NDArray[np.uint8], places: NDArray[np.int64]) -> Runs:
    """The runs of chunks whose indexes are there.

    Raises:
        ValueError: their lengths contradict one another, or compressions are several.
    """

    def numbers(at: NDArray[np.int64], kind: str, count: int = 1) -> NDArray[Any]:
        """So many little-endian numbers from each of these places."""
        size = count * np.dtype(kind).itemsize
        picked = content[at[:, None] + np.arange(size)]
        return np.ascontiguousarray(picked).view(kind).reshape(len(at), count)

    begins, ends = places.T
    if not len(places):
        return Runs(np.empty((0, 3), np.uint64), np.empty((0, 3), np.uint64))
    fixed = numbers(begins, "<u8", _TIMES)
    table = begins + 8 * _TIMES + 4
    sizes = numbers(table - 4, "<u4")[:, 0].astype(np.int64)
    names = table + sizes + 8 + 4  # after the table and the length of the messages' indexes
    if (sizes % _ENTRY).any() or (names > ends).any():
        raise ValueError("its lengths contradict one another")
    lengths = numbers(names - 4, "<u4")[:, 0].astype(np.int64)
    if (names + lengths + 16 != ends).any() or (lengths != lengths[0]).any():
        raise ValueError("its lengths contradict one another")
    if lengths[0] > _MOST_NAMES:
        raise ValueError("no compression has so long a name")
    said = content[names[:, None] + np.arange(lengths[0])]
    if (said != said[0]).any():
        raise ValueError("its chunks are compressed in several ways")
    packed, unpacked = numbers(names + lengths, "<u8", 2).T
    start, end, offset, length = fixed.T
    after = offset + length
    counts = sizes // _ENTRY
    number = np.repeat(np.arange(len(places)), counts)
    within = np.arange(len(number)) - np.repeat(np.cumsum(counts) - counts, counts)
    channels = numbers(table[number] + _ENTRY * within, "<u2")[:, 0].astype(np.int64)
    return Runs(
        np.column_stack([start, offset, end]),
        np.column_stack([after - packed, after, unpacked]),
        said[0].tobytes().decode(),
        np.column_stack([number, channels]),
    )
