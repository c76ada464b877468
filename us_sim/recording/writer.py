"""Recording MCAP as rosbag2 does, so that nothing but the last chunk is lost to a crash."""

from __future__ import annotations

import contextlib
import tempfile
from collections import Counter, deque
from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any, Literal

from mcap.writer import CompressionType, Writer
from rosbags.interfaces import Qos

from us_sim import __version__
from us_sim.errors import BagError
from us_sim.recording.mcap_storage import REMEDY
from us_sim.recording.metadata import INFORMATION, METADATA, NO_TIME, bag_information
from us_sim.recording.schemas import make_schema, parse_definitions
from us_sim.recording.topic import BagTopic, qos_to_yaml, to_yaml
from us_sim.settings.spelling import format_count
from us_sim.share import full_path

_CHUNK_SIZE = 2 * 1024 * 1024  # bytes; the writer keeps an index of each chunk in memory
_COMPRESSIONS = {"none": CompressionType.NONE, "zstd": CompressionType.ZSTD}


class BufferedFile:
    """A new file that takes every byte: what the disk has no room for waits in memory.

    Where a write fails the file is cut back to the last one that succeeded, so that it holds whole
    records at every moment. Each `flush` tries again.

    Args:
        path: of the file.
        reserve: bytes of the disk that are kept free for `use_reserve`.

    Raises:
        OSError: the file exists or cannot be made.
    """

    def __init__(self, path: Path, reserve: int = 0) -> None:
        self.error: OSError | None = None  # why bytes wait
        self._reserve = tempfile.TemporaryFile(dir=path.parent, buffering=0)  # noqa: SIM115
        self._reserve.write(bytes(reserve))
        self._stream = path.open("xb", buffering=0)
        self._waiting: deque[bytes] = deque()
        self._size = 0  # bytes in the file
        self._end = 0  # likewise, with those that wait

    def tell(self) -> int:
        """Return the bytes that were written, with those that wait."""
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
            with contextlib.suppress(OSError):
                self._stream.truncate(self._size)
                self._stream.seek(self._size)

    def use_reserve(self) -> None:
        """Write what waits where the disk had been kept free."""
        self._reserve.close()
        self.flush()

    def close(self) -> None:
        """Close the file; what waits is lost."""
        self._reserve.close()
        with contextlib.suppress(OSError):
            self._stream.close()


class BagWriter:
    """Writer of one bag: an MCAP file, and when it is closed, its ``metadata.yaml``.

    A message reaches the operating system with its chunk or with :meth:`flush`, and then survives
    the end of the process.

    Where the disk is full the file holds what fitted, :attr:`problem` says so, and what was
    written since waits in memory for room.

    Args:
        path: ``FILE.mcap``, with ``metadata.yaml`` in the same folder; or a new folder, in which
            the file is called ``FOLDER_0.mcap`` as rosbag2 does. Missing folders are made.
        compression: of the chunks, ``"none"`` or ``"zstd"``.
        chunk_size: bytes after which a chunk is ended.
        sidecar: False leaves ``metadata.yaml`` away, for folders with several one-file bags.
        further: where ``FILE.mcap`` exists, go on in ``FILE_1.mcap`` or the next that is free. No
            ``metadata.yaml`` is written then: it would have to speak for files that are not this
            writer's.
        reserve: bytes of the disk that are kept free for the last chunk and the index.

    Raises:
        BagError: something is there already, or the file cannot be made.

    Examples:
        >>> import tempfile
        >>> file = tempfile.mkdtemp() + "/session.mcap"
        >>> with BagWriter(file, compression="zstd") as writer:
        ...     writer.add_topic("/note", "std_msgs/msg/String")
        ...     hi = bytes.fromhex("00010000 03000000 686900")
        ...     writer.write_message("/note", hi, 1_700_000_000_000_000_000)
        >>> open(file, "rb").read(8)[1:6]
        b'MCAP0'
    """

    def __init__(
        self,
        path: str | Path,
        *,
        compression: Literal["none", "zstd"] = "none",
        chunk_size: int = _CHUNK_SIZE,
        sidecar: bool = True,
        further: bool = False,
        reserve: int = 0,
    ) -> None:
        if compression not in _COMPRESSIONS:
            raise BagError(f"chunks cannot be compressed with {compression!r}: use none or zstd")
        self._counts: Counter[str] = Counter()  # messages by topic
        self._start, self._end = NO_TIME, 0  # ns, of their log times
        self._topics: dict[str, BagTopic] = {}
        self._channels: dict[str, int] = {}  # by topic
        self._schemas: dict[str, int] = {}  # by type
        self._is_closed = False
        try:
            self.path, self._metadata_file = _names(Path(path), sidecar, further)
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = BufferedFile(self.path, reserve)
        except (OSError, ValueError) as error:  # ValueError: a name that no file can have
            raise _cannot_be_made(path, error) from None
        stream: Any = self._file  # which has what a Writer asks of one
        self._writer = Writer(stream, chunk_size, _COMPRESSIONS[compression])
        self._writer.start("ros2", f"us_sim {__version__}")
        # rosbag2 does this too: readers find the distribution even in a file that is cut.
        self._add_metadata()
        if self._file.error is not None:
            self._file.close()
            self.path.unlink(missing_ok=True)
            raise _cannot_be_made(self.path, self._file.error)

    @property
    def message_count(self) -> int:
        """Return the number of messages written."""
        return self._counts.total()

    @property
    def problem(self) -> str:
        """Say why messages wait for room; empty when none do."""
        if self._file.error is None or self._is_closed:
            return ""
        return f"{self._full()}: what it holds can be read, and the rest waits for room"

    def add_topic(
        self,
        topic: str,
        type_name: str,
        qos: Iterable[Qos] = (),
        type_hash: str | None = None,
        *,
        schema: str | None = None,
    ) -> None:
        """Make a topic known; adding it again with the same type adds its quality of service.

        Args:
            topic: full name.
            type_name: ``package/msg/Type``.
            qos: offered by its publishers. Later profiles are in ``metadata.yaml`` alone.
            type_hash: RIHS01 hash; computed from the definition by default.
            schema: ``ros2msg`` text; the installed or the Jazzy definition by default.

        Raises:
            BagError: the type is unknown, differs from before, or the bag is closed.
        """
        self._require_open()
        if not topic or any(character.isspace() for character in topic):
            raise BagError(f"{topic!r} is not a topic name")
        profiles = tuple(qos)
        if (known := self._topics.get(topic)) is not None:
            if known.type_name != type_name:
                raise BagError(
                    f"topic {topic} is recorded as {known.type_name}: it cannot also be {type_name}"
                )
            qualities = tuple(dict.fromkeys((*known.qos, *profiles)))
            self._topics[topic] = replace(known, qos=qualities)
            return
        schema = make_schema(type_name) if schema is None else schema
        if type_hash is None:
            type_hash = parse_definitions(type_name, schema).hash_rihs01(type_name)
        if type_name not in self._schemas:
            content = schema.encode()
            self._schemas[type_name] = self._writer.register_schema(type_name, "ros2msg", content)
        about = {"offered_qos_profiles": qos_to_yaml(profiles), "topic_type_hash": type_hash}
        schema_id = self._schemas[type_name]
        self._channels[topic] = self._writer.register_channel(topic, "cdr", schema_id, about)
        self._topics[topic] = BagTopic(topic, type_name, 0, profiles, type_hash)

    def write_message(
        self,
        topic: str,
        cdr: bytes | bytearray | memoryview,
        log_time_ns: int,
        publish_time_ns: int | None = None,
        sequence: int = 0,
    ) -> None:
        """Write one serialized message.

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
        channel, number = self._channels[topic], sequence & 0xFFFFFFFF
        self._writer.add_message(channel, log_time_ns, bytes(cdr), publish_time_ns, number)
        self._counts[topic] += 1
        self._start = min(self._start, log_time_ns)
        self._end = max(self._end, log_time_ns)

    def attach_file(self, name: str, media_type: str, data: bytes, time_ns: int) -> None:
        """Put a file into the bag, such as the scene that is recorded.

        ``media_type`` is such as ``text/plain``; ``time_ns``, ns since the epoch, says of when the
        content is.

        Raises:
            BagError: the bag is closed, or the disk is full.
        """
        self._require_open()
        self._writer.add_attachment(time_ns, time_ns, name, media_type, data)
        self.flush()

    def write_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Put texts by their names into the file, as a metadata record of MCAP.

        Raises:
            BagError: the bag is closed, or the disk is full.
        """
        self._require_open()
        self._writer.add_metadata(name, dict(values))
        self.flush()

    def flush(self) -> None:
        """End the chunk in progress, and hand everything to the operating system.

        Raises:
            BagError: the bag is closed, or the disk is full.
        """
        self._require_open()
        self._writer.flush()
        self._file.flush()
        if self.problem:
            raise BagError(self.problem)

    def close(self) -> None:
        """Write the index and ``metadata.yaml``; closing again does nothing.

        Raises:
            BagError: the disk is full; or the file was removed or moved.
        """
        if self._is_closed:
            return
        self._add_metadata()
        self._writer.finish()
        self._file.use_reserve()
        self._file.close()
        problems = []
        if self.problem:
            problems.append(f"{self._full()}; what came since and its index are missing: {REMEDY}")
        self._is_closed = True
        if not self.path.exists():
            problems.append(
                f"{self.path} was removed or moved away while it was recorded, with "
                f"{format_count(self.message_count, 'message')}"
            )
        elif self._metadata_file is not None:
            try:
                with self._metadata_file.open("x", encoding="utf-8") as file:
                    file.write(to_yaml({INFORMATION: self._information()}))
            except OSError as error:
                if not isinstance(error, FileExistsError):
                    self._metadata_file.unlink(missing_ok=True)
                problems.append(
                    f"{self._metadata_file} cannot be written ({error.strerror}): the recording "
                    f"can be read without it, and `ros2 bag reindex {self.path.parent}` writes it"
                )
        if problems:
            raise BagError("; ".join(problems))

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _require_open(self) -> None:
        if self._is_closed:
            raise BagError(f"{self.path} is closed: nothing can be written to it any more")

    def _full(self) -> str:
        assert self._file.error is not None
        return f"{self.path} cannot be written ({self._file.error.strerror})"

    def _add_metadata(self) -> None:
        information = {"serialized_metadata": to_yaml(self._information())}
        self._writer.add_metadata("rosbag2", information)
        self._writer.flush()

    def _information(self) -> dict[str, Any]:
        topics = [
            replace(topic, message_count=self._counts[name]) for name, topic in self._topics.items()
        ]
        duration = max(self._end - self._start, 0)
        return bag_information(self.path.name, topics, self._start, duration)


def _names(path: Path, sidecar: bool, further: bool) -> tuple[Path, Path | None]:
    """Choose the names of the file and of ``metadata.yaml``; None where none is written."""
    is_folder = path.suffix != ".mcap"
    stem = full_path(path).name if is_folder else path.stem
    file = path / f"{stem}_0.mcap" if is_folder else path
    if further and file.exists():
        names = (file.with_name(f"{stem}_{number}.mcap") for number in count(1))
        return next(file for file in names if not file.exists()), None
    if file.exists():
        raise BagError(f"{file} exists already: choose another name or remove it")
    if is_folder and path.is_dir() and any(path.iterdir()):
        raise BagError(f"{path} exists already and is not empty: choose another name")
    if not sidecar:
        return file, None
    metadata_file = file.with_name(METADATA)
    if metadata_file.exists():
        raise BagError(
            f"{metadata_file} belongs to another recording: record into a folder of its own, such "
            f"as {file.with_suffix('') / file.name}"
        )
    return file, metadata_file


def _cannot_be_made(path: str | Path, error: OSError | ValueError) -> BagError:
    return BagError(f"{path} cannot be made: {getattr(error, 'strerror', None) or error}")
