"""Recording MCAP as rosbag2 does, so that nothing but the last second is lost to a crash.

>>> import tempfile
>>> from us_sim.recording.writer import BagWriter
>>> file = tempfile.mkdtemp() + "/session.mcap"
>>> with BagWriter(file, compression="zstd") as writer:
...     writer.add_topic("/note", "std_msgs/msg/String")
...     writer.write("/note", bytes.fromhex("00010000 03000000 686900"), 1_700_000_000_000_000_000)
>>> open(file, "rb").read(8)
b'\\x89MCAP0\\r\\n'
"""

from __future__ import annotations

import contextlib
import os
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from itertools import count
from pathlib import Path
from typing import Any, Literal

from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Schema
from mcap.writer import CompressionType, Writer

from us_sim.errors import BagError
from us_sim.recording.metadata import BagMetadata, FileEntry
from us_sim.recording.schemas import definitions, schema_text
from us_sim.recording.topic import BagTopic, QosProfile, as_yaml, qos_to_yaml
from us_sim.settings.spelling import counted
from us_sim.share import full_path

_CHUNK_SIZE = 2 * 1024 * 1024  # bytes; the writer keeps an index of each chunk in memory
_FLUSH = 10**9  # ns of log time after which everything is handed to the operating system
_NEVER = 2**63 - 1  # ns, later than any time
_COMPRESSIONS = {"none": CompressionType.NONE, "zstd": CompressionType.ZSTD}


class PatientFile:
    """A new file that takes every byte: what the disk has no room for waits in memory.

    Where a write fails the file is cut back to the last one that succeeded, so that it holds whole
    records at every moment. Each `flush` tries again.

    Raises:
        OSError: the file exists or cannot be made.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.error: OSError | None = None  # why bytes wait
        self._stream = path.open("xb", buffering=0)
        self._waiting: deque[bytes] = deque()
        self._size = 0  # bytes in the file
        self._end = 0  # likewise, with those that wait

    def tell(self) -> int:
        """Bytes that were written, with those that wait."""
        return self._end

    def write(self, data: bytes) -> None:
        """Append whole records."""
        self._waiting.append(data)
        self._end += len(data)
        self.flush()

    def flush(self) -> None:
        """Hand what waits to the operating system."""
        try:
            while self._waiting:
                rest = memoryview(self._waiting[0])
                while rest:
                    rest = rest[self._stream.write(rest) :]
                self._size += len(self._waiting.popleft())
            self.error = None
        except OSError as error:
            self.error = error
            self._cut(self._size)

    def close(self, size: int | None = None) -> None:
        """Close the file, cut to ``size`` bytes where that is given; what waits is lost."""
        if size is not None:
            self._cut(size)
        self._waiting.clear()
        with contextlib.suppress(OSError):
            self._stream.close()

    @property
    def is_removed(self) -> bool:
        """Whether no folder holds the file any more."""
        return os.fstat(self._stream.fileno()).st_nlink == 0

    def _cut(self, size: int) -> None:
        with contextlib.suppress(OSError):
            self._stream.truncate(size)
            self._stream.seek(size)


@dataclass
class _Topic:
    type_name: str
    schema: str | None  # None where nobody knows it
    qos: tuple[QosProfile, ...]
    type_hash: str


class _Part:
    """One file of a bag."""

    def __init__(self, path: Path, compression: CompressionType, chunk_size: int) -> None:
        self.file = PatientFile(path)
        self.counts: Counter[str] = Counter()  # messages by topic, of the chunk in progress too
        self.start, self._end = _NEVER, 0  # ns, of their log times
        # What no full disk takes away any more: bytes, and the messages in them.
        self._size = 0
        self.entry, self.kept = FileEntry(path.name), self.counts.copy()
        self._schemas: dict[str, int] = {}  # by type
        self._channels: dict[str, int] = {}  # by topic
        stream: Any = self.file  # which has what a Writer asks of one
        self._writer = Writer(stream, chunk_size, compression)
        self._writer.start("ros2", _library())

    def add_topic(self, name: str, topic: _Topic) -> None:
        encoding, text = ("", "") if topic.schema is None else ("ros2msg", topic.schema)
        schema: dict[str, Any] = {"name": topic.type_name, "encoding": encoding}
        schema["data"] = text.encode()
        if topic.type_name not in self._schemas:
            self._schemas[topic.type_name] = self._writer.register_schema(**schema)
        channel: dict[str, Any] = {"topic": name, "message_encoding": "cdr"}
        channel["schema_id"] = self._schemas[topic.type_name]
        channel["metadata"] = {
            "offered_qos_profiles": qos_to_yaml(topic.qos),
            "topic_type_hash": topic.type_hash,
        }
        self._channels[name] = self._writer.register_channel(**channel)
        # Twice, here and in the next chunk: one damaged chunk makes no others unreadable.
        records = RecordBuilder()
        Schema(id=channel["schema_id"], **schema).write(records)
        Channel(id=self._channels[name], **channel).write(records)
        self.file.write(records.end())

    def write(self, topic: str, data: bytes, log_time: int, publish_time: int, number: int) -> None:
        before = self.file.tell()
        self._writer.add_message(self._channels[topic], log_time, data, publish_time, number)
        self.counts[topic] += 1
        self.start, self._end = min(self.start, log_time), max(self._end, log_time)
        if self.file.tell() > before:  # a chunk has ended with this message
            self._note_kept()

    def add_metadata(self, name: str, values: dict[str, str]) -> None:
        self._writer.add_metadata(name, values)
        self.flush()

    def attach(self, name: str, media_type: str, data: bytes, time: int) -> None:
        self._writer.add_attachment(time, time, name, media_type, data)
        self.flush()

    def flush(self) -> None:
        """End the chunk in progress, and hand everything to the operating system."""
        self._writer.flush()
        self._note_kept()

    def finish(self) -> Counter[str]:
        """Write the index and close the file; the messages that did not fit."""
        self._writer.finish()
        self.file.flush()
        fits = self.file.error is None
        if fits:
            self._note_kept()
        self.file.close(None if fits else self._size)
        return self.counts - self.kept

    def _note_kept(self) -> None:
        if self.file.error is None:
            self._size, self.kept = self.file.tell(), self.counts.copy()
            if self.counts:
                span = self.start, self._end - self.start
                self.entry = FileEntry(self.file.path.name, *span, self.counts.total())


class BagWriter:
    """Writes one bag: an MCAP file or several, and when it is closed, its ``metadata.yaml``.

    A message reaches the operating system at the latest when one comes that is a second younger,
    or with :meth:`flush`, and then survives the end of the process.

    Where the disk is full the file holds what fitted, :attr:`problem` says so, and what was
    written since waits in memory for room. Where somebody takes the file away, that is an error,
    and writing goes on in a further file at once. :attr:`lost` counts the messages that are gone.

    Args:
        path: ``FILE.mcap``, with ``metadata.yaml`` in the same folder; or a new folder, in which
            the file is called ``FOLDER_0.mcap`` as rosbag2 does. Missing folders are made. Further
            files are called ``FILE_1.mcap`` or ``FOLDER_1.mcap`` and so on.
        compression: of the chunks, ``"none"`` or ``"zstd"``.
        chunk_size: bytes after which a chunk is ended.
        max_size: bytes in the file after which a further one is begun; 0 for never.
        max_duration: s after which a further file is begun; 0 for never.
        sidecar: False leaves ``metadata.yaml`` away, for folders with several one-file bags.
        further: where ``FILE.mcap`` exists, go on in ``FILE_1.mcap`` or the next that is free. No
            ``metadata.yaml`` is written then: it would have to speak for files that are not this
            writer's.

    Raises:
        BagError: something is there already, or the file cannot be made.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        compression: Literal["none", "zstd"] = "none",
        chunk_size: int = _CHUNK_SIZE,
        max_size: int = 0,
        max_duration: float = 0.0,
        sidecar: bool = True,
        further: bool = False,
    ) -> None:
        if compression not in _COMPRESSIONS:
            raise BagError(f"chunks cannot be compressed with {compression!r}: use none or zstd")
        self.custom_data: dict[str, str] = {}  # free text for the metadata
        self.lost: Counter[str] = Counter()  # messages that no file holds, by topic
        self._options = _COMPRESSIONS[compression], chunk_size
        self._max_size, self._max_duration = max_size, round(max_duration * 1e9)
        self._files: list[FileEntry] = []  # that are closed
        self._counts: Counter[str] = Counter()  # messages in those files, by topic
        self._topics: dict[str, _Topic] = {}
        self._attachments: dict[str, tuple[str, bytes, int]] = {}
        self._last_flush: int | None = None
        self._untold: list[str] = []  # sentences for the next error
        self._ended = False
        try:
            self._name_files(Path(path), sidecar, further)
        except (OSError, ValueError) as error:  # ValueError: a name that no file can have
            raise _cannot_be_made(path, error) from None
        self._part = self._opened(self.path)

    def _name_files(self, path: Path, sidecar: bool, further: bool) -> None:
        """Choose the names of the first file and of ``metadata.yaml``."""
        is_folder = path.suffix != ".mcap"
        self._stem = full_path(path).name if is_folder else path.stem
        self.path = path / f"{self._stem}_0.mcap" if is_folder else path  # the first file
        self._metadata_file: Path | None = None
        if further and self.path.exists():
            self.path = self._further_file()
            return
        if self.path.exists():
            raise BagError(f"{self.path} exists already: choose another name or remove it")
        if is_folder and path.is_dir() and any(path.iterdir()):
            raise BagError(f"{path} exists already and is not empty: choose another name")
        if not sidecar:
            return
        self._metadata_file = self.path.with_name("metadata.yaml")
        if self._metadata_file.exists():
            own = self.path.with_suffix("") / self.path.name
            raise BagError(
                f"{self._metadata_file} belongs to another recording: record into a folder of its "
                f"own, such as {own}"
            )

    def _further_file(self) -> Path:
        """The next file that is not there."""
        names = (self.path.with_name(f"{self._stem}_{number}.mcap") for number in count(1))
        return next(file for file in names if not file.exists())

    @property
    def message_count(self) -> int:
        """Number of messages written."""
        return self._counts.total() + (0 if self._ended else self._part.counts.total())

    @property
    def topics(self) -> tuple[str, ...]:
        """Names of the topics added."""
        return tuple(self._topics)

    @property
    def problem(self) -> str:
        """Why messages wait for room; empty when none do."""
        file = self._part.file
        if file.error is None or self._ended:
            return ""
        return f"{_cannot_be_written(file)}: what it holds can be read, and the rest waits for room"

    def add_topic(
        self,
        topic: str,
        type_name: str,
        qos: Sequence[object] = (),
        type_hash: str | None = None,
        *,
        schema: str | None = None,
        defined: bool = True,
    ) -> None:
        """Makes a topic known; adding it again with the same type adds its quality of service.

        Args:
            topic: full name.
            type_name: ``package/msg/Type``.
            qos: offered by its publishers, in any form that ``QosProfile.of`` takes. Later profiles
                are in ``metadata.yaml`` and in files begun after that.
            type_hash: RIHS01 hash; computed from the definition by default.
            schema: ``ros2msg`` text; the installed or the Jazzy definition by default.
            defined: False takes a type whose definition is not known, and writes none.

        Raises:
            BagError: the type is unknown, differs from before, or the bag is closed.
        """
        self._require_open()
        if not topic or any(character.isspace() for character in topic):
            raise BagError(f"{topic!r} is not a topic name")
        profiles = tuple(map(QosProfile.of, qos))
        if (known := self._topics.get(topic)) is not None:
            if known.type_name != type_name:
                raise BagError(
                    f"topic {topic} is recorded as {known.type_name}: it cannot also be {type_name}"
                )
            known.qos = tuple(dict.fromkeys((*known.qos, *profiles)))
            return
        try:
            schema = schema_text(type_name) if schema is None else schema
            if type_hash is None:
                type_hash = definitions(type_name, schema).hash_rihs01(type_name)
        except BagError:
            if defined:
                raise
        self._topics[topic] = _Topic(type_name, schema, profiles, type_hash or "")
        self._part.add_topic(topic, self._topics[topic])

    def write(
        self,
        topic: str,
        cdr: bytes | bytearray | memoryview,
        log_time_ns: int,
        publish_time_ns: int | None = None,
        sequence: int = 0,
    ) -> None:
        """Writes one serialized message.

        Args:
            topic: added before.
            cdr: the message with its encapsulation header, as it came from the wire.
            log_time_ns: ns since the epoch, when it was received.
            publish_time_ns: ns since the epoch, when it was sent; the log time by default.
            sequence: number of the message on its topic, where one is kept.

        Raises:
            BagError: the topic is unknown, a time is negative, the bag is closed, or earlier
                messages wait for room on the disk. The message is not written then.
        """
        if topic not in self._topics:
            raise BagError(f"topic {topic} was not added to {self.path}: call add_topic first")
        self._require_open()
        if publish_time_ns is None:
            publish_time_ns = log_time_ns
        if log_time_ns < 0 or publish_time_ns < 0:
            raise BagError(
                f"a message on {topic} has a time before 1970: log time {log_time_ns} ns, publish "
                f"time {publish_time_ns} ns"
            )
        if self.problem:
            self.flush()
        is_late = 0 < self._max_duration < log_time_ns - self._part.start
        if is_late or 0 < self._max_size <= self._part.file.tell():
            with contextlib.suppress(BagError):  # the present file takes it, too
                self._go_on()
        number = sequence & 0xFFFFFFFF
        self._part.write(topic, bytes(cdr), log_time_ns, publish_time_ns, number)
        if self._last_flush is None:
            self._last_flush = log_time_ns
        elif log_time_ns - self._last_flush >= _FLUSH:
            self._part.flush()
            self._last_flush = log_time_ns

    def attach(self, name: str, media_type: str, data: bytes, time_ns: int) -> None:
        """Puts a file into each of the bag's, such as the scene that is recorded.

        ``media_type`` is such as ``text/plain``; ``time_ns``, ns since the epoch, says of when the
        content is.

        Raises:
            BagError: the bag is closed, or the disk is full.
        """
        self._require_open()
        self._attachments[name] = media_type, data, time_ns
        self._part.attach(name, media_type, data, time_ns)
        self._tell()

    def note(self, name: str, values: Mapping[str, str]) -> None:
        """Puts texts by their names into the present file, as a metadata record of MCAP.

        Raises:
            BagError: the bag is closed, or the disk is full.
        """
        self._require_open()
        self._part.add_metadata(name, dict(values))
        self._tell()

    def flush(self) -> None:
        """Ends the chunk and hands everything to the operating system.

        Raises:
            BagError: the bag is closed, the disk is full, or the file was removed or moved; then
                the next messages are written to a further one.
        """
        self._require_open()
        self._part.flush()
        if not self._part.file.path.exists():
            self._go_on()
        self._tell()

    def split(self) -> None:
        """Ends the present file and goes on in a further one.

        Raises:
            BagError: the bag is closed, or the disk is full; or the file was removed or moved.
        """
        self._require_open()
        self._go_on()
        self._tell()

    def close(self) -> None:
        """Writes the index and ``metadata.yaml``; closing again does nothing.

        Raises:
            BagError: the disk is full, with the number of messages that are lost; or the file was
                removed or moved.
        """
        if self._ended:
            return
        self._finish(self._part)
        self._ended = True
        if self._metadata_file is not None and self._files:
            self._write_metadata_file(self._metadata_file)
        self._tell()

    def _write_metadata_file(self, metadata_file: Path) -> None:
        try:
            with metadata_file.open("x", encoding="utf-8") as file:
                file.write(self._metadata(self._files, self._counts).document())
        except OSError as error:
            if not isinstance(error, FileExistsError):
                metadata_file.unlink(missing_ok=True)
            self._untold.append(
                f"{metadata_file} cannot be written ({error.strerror}): the recording can be read "
                f"without it, and `us-sim bag repair {metadata_file.parent}` makes a bag that has "
                f"it"
            )

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _require_open(self) -> None:
        if self._ended:
            raise BagError(f"{self.path} is closed: nothing can be written to it any more")

    def _opened(self, path: Path) -> _Part:
        """A new file with all topics so far and the attachments."""
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            part = _Part(path, *self._options)
        except (OSError, ValueError) as error:
            raise _cannot_be_made(path, error) from None
        for name, topic in self._topics.items():
            part.add_topic(name, topic)
        # rosbag2 does this too: readers find the distribution even in a file that is cut.
        self._add_metadata(part)
        for name, attachment in self._attachments.items():
            part.attach(name, *attachment)
        if part.file.error is not None:
            part.file.close()
            path.unlink(missing_ok=True)
            raise _cannot_be_made(path, part.file.error)
        return part

    def _go_on(self) -> None:
        """Begin a further file, and end the present one, unless the disk is full."""
        self._part.flush()
        if self._part.file.error is None:
            further = self._opened(self._further_file())
            closed, self._part = self._part, further
            self._finish(closed)

    def _finish(self, part: _Part) -> None:
        """Give a file its index, close it and count its messages."""
        is_taken, is_removed = not part.file.path.exists(), part.file.is_removed
        part.flush()
        self._add_metadata(part)
        lost = part.finish()
        if is_taken:
            self.lost += part.counts if is_removed else lost
            self._untold.append(
                f"{part.file.path} was {'removed' if is_removed else 'moved away'} while it was "
                f"recorded, with {counted(part.counts.total(), 'message')}"
            )
            return
        self._files.append(part.entry)
        self._counts += part.kept
        self.lost += lost
        if part.file.error is not None:
            self._untold.append(
                f"{_cannot_be_written(part.file)}; {counted(lost.total(), 'message')} and its "
                f"index are missing, and `us-sim bag repair` makes an index where there is room"
            )

    def _tell(self) -> None:
        """Raise an error where something went wrong of which nobody was told."""
        told, self._untold = [*self._untold, *filter(None, [self.problem])], []
        if told:
            raise BagError("; ".join(told))

    def _add_metadata(self, part: _Part) -> None:
        information = self._metadata([*self._files, part.entry], self._counts + part.kept)
        part.add_metadata("rosbag2", {"serialized_metadata": as_yaml(information.information())})

    def _metadata(self, files: Sequence[FileEntry], counts: Mapping[str, int]) -> BagMetadata:
        filled = [file for file in files if file.message_count]
        start = min((file.start for file in filled), default=files[0].start)
        end = max((file.start + file.duration for file in filled), default=start)
        return BagMetadata(
            files=tuple(files),
            topics=tuple(
                BagTopic(name, known.type_name, counts[name], known.qos, known.type_hash)
                for name, known in self._topics.items()
            ),
            start=start,
            duration=end - start,
            message_count=sum(counts.values()),
            ros_distro=os.environ.get("ROS_DISTRO") or "jazzy",
            custom_data=self.custom_data,
        )


def _cannot_be_made(path: str | Path, error: OSError | ValueError) -> BagError:
    return BagError(f"{path} cannot be made: {getattr(error, 'strerror', None) or error}")


def _cannot_be_written(file: PatientFile) -> str:
    assert file.error is not None
    return f"{file.path} cannot be written ({file.error.strerror})"


def _library() -> str:
    try:
        return f"us_sim {version('us_sim')}"
    except PackageNotFoundError:
        return "us_sim"
