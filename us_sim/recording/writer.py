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
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from itertools import count
from pathlib import Path
from typing import Literal

from us_sim.errors import BagError, FileTakenError
from us_sim.recording.mcap_output import McapOutput, Place
from us_sim.recording.metadata import BagMetadata, FileEntry, TopicEntry
from us_sim.recording.schemas import definitions, schema_text
from us_sim.recording.topic import QosProfile, qos_to_yaml
from us_sim.settings.spelling import counted
from us_sim.share import full_path

_CHUNK_SIZE = 768 * 1024  # bytes, rosbag2's default
_FLUSH = 10**9  # ns of log time after which everything is handed to the operating system
_ROOM = 16 * 1024 * 1024  # bytes, that must be free again before a full disk is written to
_COMPRESSIONS = {"none": "", "zstd": "zstd"}


@dataclass
class _Topic:
    type_name: str
    schema: str | None  # None where nobody knows it
    qos: tuple[QosProfile, ...]
    type_hash: str


class BagWriter:
    """Writes one bag: an MCAP file or several, and when it is closed, its ``metadata.yaml``.

    A message reaches the operating system at the latest when one comes that is a second younger,
    or with :meth:`flush`, and then survives the end of the process.

    Where the disk is full the file gets its index and is closed, :meth:`resume` goes on in another
    one when there is room again, and :attr:`lost` counts the messages that did not fit. Where
    somebody takes the file or a part of it away, that is an error as well, and writing goes on in
    another one at once.

    Args:
        path: ``FILE.mcap``, with ``metadata.yaml`` in the same folder; or a new folder, in which
            the file is called ``FOLDER_0.mcap`` as rosbag2 does. Missing folders are made. Further
            files are called ``FILE_1.mcap`` or ``FOLDER_1.mcap`` and so on.
        compression: of the chunks, ``"none"`` or ``"zstd"``.
        chunk_size: bytes after which a chunk is ended.
        max_size: bytes after which a further file is begun; 0 for never.
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
        self.lost: Counter[str] = Counter()  # messages that the disk did not take, by topic
        self._compression, self._chunk_size = _COMPRESSIONS[compression], chunk_size
        self._max_size, self._max_duration = max_size, round(max_duration * 1e9)
        self._files: list[FileEntry] = []  # that are closed
        self._counts: Counter[str] = Counter()  # messages in those files, by topic
        self._topics: dict[str, _Topic] = {}
        self._attachments: dict[str, tuple[str, bytes, int]] = {}
        self._last_flush: int | None = None
        self._closed_because = ""
        self._taken_away: list[str] = []  # sentences that nobody has been told yet
        self._ended = False
        try:
            self._name_files(Path(path), sidecar, further)
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._output = self._opened(self.path)
        except OSError as error:
            raise BagError(f"{path} cannot be made: {error.strerror}") from None
        except ValueError as error:  # a name that no file can have
            raise BagError(f"{path} cannot be made: {error}") from None

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
        present = 0 if self._output.is_finished else self._output.message_count
        return self._counts.total() + present

    @property
    def topics(self) -> tuple[str, ...]:
        """Names of the topics added."""
        return tuple(self._topics)

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
        if self._ended:
            raise BagError(self._closed_because)
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
        self._introduce(topic, self._output)

    def _introduce(self, topic: str, output: McapOutput) -> None:
        """Make a topic known to a file."""
        known = self._topics[topic]
        metadata = {
            "offered_qos_profiles": qos_to_yaml(known.qos),
            "topic_type_hash": known.type_hash,
        }
        output.add_topic(topic, known.type_name, known.schema, metadata)

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
            BagError: the topic is unknown, a time is negative, the bag is closed, or the disk is
                full; earlier messages stay readable.
        """
        if topic not in self._topics:
            raise BagError(f"topic {topic} was not added to {self.path}: call add_topic first")
        if self._closed_because:
            self.lost[topic] += 1
            raise BagError(self._closed_because)
        if publish_time_ns is None:
            publish_time_ns = log_time_ns
        if log_time_ns < 0 or publish_time_ns < 0:
            raise BagError(
                f"a message on {topic} has a time before 1970: log time {log_time_ns} ns, publish "
                f"time {publish_time_ns} ns"
            )
        if self._is_long(log_time_ns):
            self.split()
        with self._writing():
            times = log_time_ns, publish_time_ns
            self._output.add_message(topic, *times, sequence & 0xFFFFFFFF, bytes(cdr))
        if self._last_flush is None:
            self._last_flush = log_time_ns
        elif log_time_ns - self._last_flush >= _FLUSH:
            self.flush()
            self._last_flush = log_time_ns

    def attach(self, name: str, media_type: str, data: bytes, time_ns: int) -> None:
        """Puts a file into each of the bag's, such as the scene that is recorded.

        ``media_type`` is such as ``text/plain``; ``time_ns``, ns since the epoch, says of when the
        content is.

        Raises:
            BagError: the bag is closed, or the disk is full.
        """
        self._attachments[name] = media_type, data, time_ns
        with self._writing():
            self._output.add_attachment(name, *self._attachments[name])

    def note(self, name: str, values: Mapping[str, str]) -> None:
        """Puts texts by their names into the present file, as a metadata record of MCAP.

        Raises:
            BagError: the bag is closed, or the disk is full.
        """
        with self._writing():
            self._output.add_metadata(name, dict(values))

    def flush(self) -> None:
        """Ends the chunk and hands everything to the operating system.

        Raises:
            BagError: the bag is closed, or the disk is full.
            FileTakenError: the file was removed or moved.
        """
        with self._writing():
            self._output.end_chunk()
            if self._output.place is not Place.HERE:
                self._go_on()
        self._tell_taken_away(f"; the recording goes on in {self._output.path}")

    def split(self) -> None:
        """Ends the present file and goes on in a further one.

        Raises:
            BagError: the bag is closed, or the disk is full.
            FileTakenError: the file was removed or moved.
        """
        with self._writing():
            self._go_on()
        self._tell_taken_away(f"; the recording goes on in {self._output.path}")

    def resume(self) -> bool:
        """After the disk was full: whether there is room again, and a further file is begun."""
        if self._closed_because:
            with contextlib.suppress(OSError):
                self.path.parent.mkdir(parents=True, exist_ok=True)
                if shutil.disk_usage(self.path.parent).free >= _ROOM:
                    self._output = self._opened(self._further_file())
                    self._closed_because = ""
        return not self._closed_because

    def close(self) -> None:
        """Writes the index and ``metadata.yaml``; closing again does nothing.

        Raises:
            BagError: the disk is full; earlier messages stay readable.
            FileTakenError: the file was removed or moved.
        """
        self._ended = True
        if not self._closed_because:
            with self._writing():
                self._add_metadata(self._output)
                self._finish()
            self._closed_because = f"{self.path} is closed: nothing can be written to it any more"
        self._write_metadata_file()
        self._tell_taken_away()

    def _write_metadata_file(self) -> None:
        metadata_file, self._metadata_file = self._metadata_file, None
        if metadata_file is None or not self._files:
            return
        try:
            with metadata_file.open("x", encoding="utf-8") as file:
                file.write(self._metadata(None).document())
        except OSError as error:
            with contextlib.suppress(OSError):
                if not isinstance(error, FileExistsError):
                    metadata_file.unlink()
            raise BagError(
                f"{metadata_file} cannot be written ({error.strerror}): the recording can be read "
                f"without it, and `us-sim bag repair {metadata_file.parent}` makes a bag that has "
                f"it"
            ) from None

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _is_long(self, time: int) -> bool:
        """Whether the file is as large or long as one may be, before a message of that time."""
        file = self._output
        if self._max_size and file.size >= self._max_size:
            return True
        late = file.start is not None and time - file.start > self._max_duration
        return bool(self._max_duration and late)

    def _opened(self, path: Path) -> McapOutput:
        """A new file with all topics so far and the attachments."""
        output = McapOutput(
            path, _library(), compression=self._compression, chunk_size=self._chunk_size
        )
        for topic in self.topics:
            self._introduce(topic, output)
        try:
            # rosbag2 does this too: readers find the distribution even in a file that is cut.
            self._add_metadata(output)
            for name, attachment in self._attachments.items():
                output.add_attachment(name, *attachment)
        except OSError:
            with contextlib.suppress(OSError):
                output.finish()
            path.unlink()
            raise
        return output

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """Stop at a failure of the disk, with an error that says how much is kept."""
        if self._closed_because:
            raise BagError(self._closed_because)
        try:
            yield
        except OSError as error:
            with contextlib.suppress(OSError):
                self._finish()
            kept = f"the first {counted(self._output.message_count, 'message')} can be read"
            if self._taken_away:
                kept = "; ".join(self._taken_away)
                self._taken_away.clear()
            self._closed_because = (
                f"{error.filename or self._output.path} cannot be written ({error.strerror}): "
                f"the recording stops, and {kept}"
            )
            raise BagError(self._closed_because) from None

    def _go_on(self) -> None:
        """End the present file, and begin a further one."""
        closed = self._output
        self._add_metadata(closed)
        self._finish()
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._output = self._opened(self._further_file())

    def _finish(self) -> None:
        """Give the present file its index, close it and count its messages."""
        file = self._output
        if file.is_finished:
            return
        place = file.place
        try:
            file.finish()
        finally:
            self.lost += file.dropped
            if place in (Place.HERE, Place.CUT):
                self._files.append(_entry(file))
                self._counts += file.counts
            if place is Place.CUT:
                self._taken_away.append(
                    f"{file.path} was cut by another process while it was recorded: "
                    f"{file.dropped.total()} messages are lost, and {file.message_count} are in it"
                )
            elif place is Place.MOVED:
                self._taken_away.append(
                    f"{file.path} was moved away while it was recorded, with "
                    f"{counted(file.message_count, 'message')}"
                )
            elif place is Place.REMOVED:
                self.lost += file.counts
                self._taken_away.append(
                    f"{file.path} was removed while it was recorded: "
                    f"{counted(file.message_count, 'message is', 'messages are')} lost with it"
                )

    def _tell_taken_away(self, then: str = "") -> None:
        """Raise FileTakenError where a file was taken away, once."""
        told, self._taken_away = "; ".join(self._taken_away), []
        if told:
            raise FileTakenError(told + then)

    def _add_metadata(self, output: McapOutput) -> None:
        lines = self._metadata(output).lines()
        output.add_metadata("rosbag2", {"serialized_metadata": "\n".join(lines)})

    def _metadata(self, present: McapOutput | None) -> BagMetadata:
        """Metadata of the closed files, and of the present one."""
        files, counts = [*self._files], self._counts
        if present is not None:
            files.append(_entry(present))
            counts = counts + present.counts
        filled = [file for file in files if file.message_count]
        start = min((file.start for file in filled), default=files[0].start)
        end = max((file.start + file.duration for file in filled), default=start)
        return BagMetadata(
            files=tuple(files),
            topics=tuple(
                TopicEntry(name, known.type_name, known.qos, known.type_hash, counts[name])
                for name, known in self._topics.items()
            ),
            start=start,
            duration=end - start,
            message_count=counts.total(),
            ros_distro=os.environ.get("ROS_DISTRO") or "jazzy",
            custom_data=self.custom_data,
        )


def _entry(output: McapOutput) -> FileEntry:
    if output.start is None or output.end is None:
        return FileEntry(output.path.name)
    duration = output.end - output.start
    return FileEntry(output.path.name, output.start, duration, output.message_count)


def _library() -> str:
    try:
        return f"us_sim {version('us_sim')}"
    except PackageNotFoundError:
        return "us_sim"
