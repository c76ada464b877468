"""Reading one MCAP file: by the index in its summary, else by what `salvage` finds of it.

The index and the records are mcap's. Its ``iter_messages`` is not used: it ends at the first
damaged chunk, and takes 3.4 times as long as this for small messages.
"""

from __future__ import annotations

import contextlib
import heapq
import struct
import zlib
from collections.abc import Collection, Iterator, Set
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from us_sim.errors import BagError
from us_sim.recording.salvage import (
    DAMAGE,
    HEADER,
    MESSAGE,
    Contents,
    Place,
    Run,
    parsed,
    parsed_attachment,
    records_in,
    salvage,
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

_FOOTER = struct.Struct("<BQQQI")  # opcode, length, start of the summary and its offsets, CRC
_CRC_AND_MAGIC = 12  # bytes at the end of the file that its checksum does not cover
_LAST = 2**63 - 1  # ns
_PLACES_TOLD = 3

_Ordered = tuple[int, int, int, BagMessage]  # log time, offset of the run, place in it, message


class McapStorage:
    """One MCAP file as a Storage; errors call it by the label.

    Raises:
        BagError: it holds a topic of two types.
    """

    def __init__(self, path: Path, label: str) -> None:
        self._path = path
        self._label = label
        with path.open("rb") as stream:
            index = _index(stream)
            self._held = index or salvage(stream, label)
        self.is_indexed = index is not None
        self.faults, self.start, self.end = self._held.faults, self._held.start, self._held.end
        self._held.runs.sort()
        self.topics = self._topics()

    def attachments(self, damage: list[Fault] | None) -> Iterator[BagAttachment]:
        """The files within this one; ``damage`` and errors are as in `Bag.attachments`."""
        for place in self._held.attachments:
            try:
                record = parsed_attachment(self._content(place))
            except DAMAGE as error:
                self._tell(damage, f"its attached file {place.name}: {error}")
            else:
                yield BagAttachment(record.name, record.media_type, record.log_time, record.data)

    def notes(self, damage: list[Fault] | None) -> Iterator[BagNote]:
        """The metadata records; ``damage`` and errors are as those of `attachments`."""
        for place in self._held.notes:
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
        wanted = self._wanted(topics)
        total = sum(self._held.counts[id] for id in wanted)
        read = outside = 0
        broken: list[Fault] = []
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
                            outside += not run.start <= each[0] <= run.end
                            heapq.heappush(pending, each)
                except DAMAGE as error:
                    where = f"its chunk at byte {run.offset}: {error}"
                    self._tell(broken if damage is not None else None, where)
        while pending:
            yield heapq.heappop(pending)[-1]
        if read < total and since is None:
            told = [fault.text for fault in broken[:_PLACES_TOLD]]
            if broken[_PLACES_TOLD:]:
                told.append(f"and {len(broken) - _PLACES_TOLD} more places")
            lost = f"{self._label}: {total - read} of its {total} messages cannot be read"
            broken = [Fault("; ".join([*told, lost]), total - read)]
            if damage is None:
                raise BagError(broken[0].text)
        if damage is not None:
            damage += broken
            if outside:
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
        with self._path.open("rb") as stream:
            for id, kind in self._wanted(topics).items():
                kept: list[_Ordered] = []
                only = {id}
                runs = [r for r in self._held.runs if r.start < before and _may_hold(r, only)]
                for run in sorted(runs, key=lambda run: run.end, reverse=True):
                    if len(kept) == count and run.end < kept[0][0]:
                        break  # as do all that end earlier
                    with contextlib.suppress(*DAMAGE):
                        held = _messages(stream, run, {id: kind})
                        kept += [each for each in held if each[0] < before]
                    kept = sorted(kept)[-count:]
                found += [message for *_, message in kept]
        return found

    def _wanted(self, topics: Collection[str]) -> dict[int, tuple[str, str]]:
        """Name and type of each channel of these topics."""
        return {
            id: (channel.topic, _type_name(self._held.schemas.get(channel.schema_id)))
            for id, channel in self._held.channels.items()
            if channel.topic in topics
        }

    def _tell(self, damage: list[Fault] | None, place: str) -> None:
        """Note damage, or raise it as a BagError."""
        text = f"{self._label} is damaged in {place}"
        if damage is None:
            remedy = "`us-sim bag repair` writes all that can be read as a new bag"
            raise BagError(f"{text}; {remedy}") from None
        damage.append(Fault(text))

    def _content(self, place: Place) -> memoryview:
        """A record without opcode and length."""
        with self._path.open("rb") as stream:
            stream.seek(place.offset + HEADER.size)
            return memoryview(stream.read(place.length - HEADER.size))

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


def _may_hold(run: Run, channels: Set[int]) -> bool:
    return not run.channels or not channels.isdisjoint(run.channels)


def _messages(stream: BinaryIO, run: Run, wanted: dict[int, tuple[str, str]]) -> Iterator[_Ordered]:
    """The messages of a run on channels of which name and type are given.

    Raises:
        DAMAGE: it is not sound.
    """
    stream.seek(run.offset)
    record = memoryview(stream.read(run.length))
    is_chunk = record[:1] != bytes([Opcode.MESSAGE])
    held = records_in(record) if is_chunk else [(int(Opcode.MESSAGE), record[HEADER.size :])]
    for place, (opcode, content) in enumerate(held):
        if opcode == Opcode.MESSAGE:
            channel, sequence, time, sent = MESSAGE.unpack_from(content)
            if channel in wanted:
                if time > _LAST or sent > _LAST:
                    raise ValueError("a message is of a time after the year 2262")
                data = bytes(content[MESSAGE.size :])
                message = BagMessage(*wanted[channel], time, sent, data, sequence)
                yield time, run.offset, place, message


def _index(stream: BinaryIO) -> Contents | None:
    """Read the contents of a file that has a sound index of every chunk."""
    try:
        summary = make_reader(stream).get_summary()
        stream.seek(-_FOOTER.size - len(MCAP0_MAGIC), 2)
        _, _, start, _, crc = _FOOTER.unpack(stream.read(_FOOTER.size))
        stream.seek(start)
        covered = stream.read()[:-_CRC_AND_MAGIC]
    except (*DAMAGE, OSError):
        return None
    statistics = summary.statistics if summary else None
    if summary is None or statistics is None or (crc and zlib.crc32(covered) != crc):
        return None
    found = Contents()
    found.schemas, found.channels = dict(summary.schemas), dict(summary.channels)
    for each in summary.chunk_indexes:
        times = each.message_start_time, each.chunk_start_offset, each.message_end_time
        found.runs.append(Run(*times, each.chunk_length, tuple(each.message_index_offsets)))
    found.attachments = [Place(e.offset, e.length, e.name) for e in summary.attachment_indexes]
    found.notes = [Place(e.offset, e.length, e.name) for e in summary.metadata_indexes]
    if statistics.message_count:
        found.start, found.end = statistics.message_start_time, statistics.message_end_time
    found.counts.update(statistics.channel_message_counts)
    is_whole = len(found.runs) == statistics.chunk_count and (
        found.runs or not statistics.message_count
    )
    return found if is_whole and found.channels.keys() >= found.counts.keys() else None


def _type_name(schema: Schema | None) -> str:
    return normalized_type(schema.name) if schema else ""
