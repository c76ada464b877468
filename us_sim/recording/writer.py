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
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import TracebackType
from typing import Literal

from mcap.writer import CompressionType, Writer

from us_sim.errors import BagError
from us_sim.recording.metadata import BagMetadata, FileEntry, TopicEntry
from us_sim.recording.qos import QosProfile, qos_to_yaml
from us_sim.recording.schemas import definitions, schema_text

__all__ = ["BagWriter"]

_CHUNK_SIZE = 768 * 1024  # bytes, rosbag2's default
_COMPRESSIONS = {"none": CompressionType.NONE, "zstd": CompressionType.ZSTD}


@dataclass
class _Channel:
    """A topic being written."""

    id: int
    type_name: str
    qos: tuple[QosProfile, ...]
    type_hash: str
    message_count: int = 0


class BagWriter:
    """Writes one bag: an MCAP file and, when it is closed, its ``metadata.yaml``.

    A message reaches the operating system at the latest when one comes that is a second younger,
    or with :meth:`flush`, and then survives the end of the process.

    Args:
        path: ``FILE.mcap``, with ``metadata.yaml`` in the same folder; or a new folder, in which
            the file is called ``FOLDER_0.mcap`` as rosbag2 does. Missing folders are made.
        compression: of the chunks, ``"none"`` or ``"zstd"``.
        chunk_size: bytes after which a chunk is ended.
        flush_interval: s of log time after which everything is handed to the operating system.
        sidecar: False leaves ``metadata.yaml`` away, for folders with several one-file bags.
        custom_data: free text for the metadata.

    Raises:
        BagError: something is there already, or the file cannot be made.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        compression: Literal["none", "zstd"] = "none",
        chunk_size: int = _CHUNK_SIZE,
        flush_interval: float = 1.0,
        sidecar: bool = True,
        custom_data: Mapping[str, str] | None = None,
    ) -> None:
        if compression not in _COMPRESSIONS:
            raise BagError(f"chunks cannot be compressed with {compression!r}: use none or zstd")
        path = Path(path)
        if path.suffix == ".mcap":
            self.path = path
        else:
            self.path = path / f"{path.resolve().name}_0.mcap"
        self._metadata_file = self.path.with_name("metadata.yaml") if sidecar else None
        self._flush_interval = round(flush_interval * 1e9)
        self._custom_data = dict(custom_data or {})
        self._channels: dict[str, _Channel] = {}
        self._schemas: dict[str, int] = {}
        self._start: int | None = None
        self._end: int | None = None
        self._last_flush: int | None = None
        self._message_count = 0
        self._safe_count = 0
        self._closed_because = ""
        self._refuse_to_overwrite(is_folder=path.suffix != ".mcap", folder=path)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = self.path.open("xb")
        except OSError as error:
            raise BagError(f"{self.path} cannot be made: {error.strerror}") from None
        self._writer = Writer(
            self._file, chunk_size=chunk_size, compression=_COMPRESSIONS[compression]
        )
        with self._writing():
            self._writer.start(profile="ros2", library=_library())
            # rosbag2 does this too: readers find the distribution even in a file that is cut.
            self._add_metadata()
            self._file.flush()

    @property
    def message_count(self) -> int:
        """Number of messages written."""
        return self._message_count

    @property
    def topics(self) -> tuple[str, ...]:
        """Names of the topics added."""
        return tuple(self._channels)

    def add_topic(
        self,
        topic: str,
        type_name: str,
        qos: Sequence[object] = (),
        type_hash: str | None = None,
        *,
        schema: str | None = None,
    ) -> None:
        """Makes a topic known; adding it again with the same type changes nothing.

        Args:
            topic: full name.
            type_name: ``package/msg/Type``.
            qos: what its publishers offer, in any form that ``QosProfile.of`` takes.
            type_hash: RIHS01 hash; computed from the definition by default.
            schema: ``ros2msg`` text; the installed or the Jazzy definition by default.

        Raises:
            BagError: the type is unknown, differs from before, or the bag is closed.
        """
        self._check_open()
        if not topic or any(character.isspace() for character in topic):
            raise BagError(f"{topic!r} is not a topic name")
        if (known := self._channels.get(topic)) is not None:
            if known.type_name != type_name:
                raise BagError(
                    f"topic {topic} is recorded as {known.type_name}: it cannot also be {type_name}"
                )
            return
        profiles = tuple(map(QosProfile.of, qos))
        text = schema_text(type_name) if schema is None else schema
        if type_hash is None:
            type_hash = definitions(type_name, text).hash_rihs01(type_name)
        with self._writing():
            if type_name not in self._schemas:
                self._schemas[type_name] = self._writer.register_schema(
                    type_name, "ros2msg", text.encode()
                )
            id = self._writer.register_channel(
                topic,
                "cdr",
                self._schemas[type_name],
                {"offered_qos_profiles": qos_to_yaml(profiles), "topic_type_hash": type_hash},
            )
        self._channels[topic] = _Channel(id, type_name, profiles, type_hash)

    def write(
        self,
        topic: str,
        cdr: bytes | bytearray | memoryview,
        log_time_ns: int,
        publish_time_ns: int | None = None,
    ) -> None:
        """Writes one serialized message.

        Args:
            topic: added before.
            cdr: the message with its encapsulation header, as it came from the wire.
            log_time_ns: ns since the epoch, when it was received.
            publish_time_ns: ns since the epoch, when it was sent; the log time by default.

        Raises:
            BagError: the topic is unknown, a time is negative, the bag is closed, or the disk is
                full; what was written before stays readable.
        """
        self._check_open()
        channel = self._channels.get(topic)
        if channel is None:
            raise BagError(f"topic {topic} was not added to {self.path}: call add_topic first")
        if publish_time_ns is None:
            publish_time_ns = log_time_ns
        if log_time_ns < 0 or publish_time_ns < 0:
            raise BagError(
                f"a message on {topic} has a time before 1970: log time {log_time_ns} ns, publish "
                f"time {publish_time_ns} ns"
            )
        with self._writing():
            self._writer.add_message(channel.id, log_time_ns, bytes(cdr), publish_time_ns)
        channel.message_count += 1
        self._message_count += 1
        self._start = log_time_ns if self._start is None else min(self._start, log_time_ns)
        self._end = log_time_ns if self._end is None else max(self._end, log_time_ns)
        if self._last_flush is None:
            self._last_flush = log_time_ns
        elif log_time_ns - self._last_flush >= self._flush_interval:
            self.flush()
            self._last_flush = log_time_ns

    def flush(self) -> None:
        """Ends the chunk and hands everything to the operating system.

        Raises:
            BagError: the bag is closed, or the disk is full.
        """
        self._check_open()
        with self._writing():
            self._writer.flush()
        self._safe_count = self._message_count

    def close(self) -> None:
        """Writes the index and ``metadata.yaml``; closing again does nothing.

        Raises:
            BagError: the disk is full; what was written before stays readable.
        """
        if self._closed_because:
            return
        with self._writing():
            self._writer.flush()
            self._safe_count = self._message_count
            self._add_metadata()
            self._writer.finish()
            self._file.close()
            if self._metadata_file is not None:
                with self._metadata_file.open("x", encoding="utf-8") as file:
                    file.write(self._metadata().document())
        self._closed_because = f"{self.path} is closed: nothing can be written to it any more"

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _refuse_to_overwrite(self, *, is_folder: bool, folder: Path) -> None:
        if self.path.exists():
            raise BagError(f"{self.path} exists already: choose another name or remove it")
        if is_folder and folder.is_dir() and any(folder.iterdir()):
            raise BagError(f"{folder} exists already and is not empty: choose another name")
        if self._metadata_file is not None and self._metadata_file.exists():
            own = self.path.with_suffix("") / self.path.name
            raise BagError(
                f"{self._metadata_file} belongs to another recording: record into a folder of its "
                f"own, such as {own}"
            )

    def _check_open(self) -> None:
        if self._closed_because:
            raise BagError(self._closed_because)

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """Turns a failure of the disk into an error that says what is kept, and stops there."""
        try:
            yield
        except OSError as error:
            self._closed_because = (
                f"{self.path} cannot be written ({error.strerror}): the recording stops, and its "
                f"first {self._safe_count} messages are kept and can be read"
            )
            with contextlib.suppress(OSError):
                self._file.close()
            raise BagError(self._closed_because) from None

    def _add_metadata(self) -> None:
        self._writer.add_metadata(
            "rosbag2", {"serialized_metadata": "\n".join(self._metadata().lines())}
        )

    def _metadata(self) -> BagMetadata:
        empty = FileEntry(self.path.name)
        start = empty.start if self._start is None else self._start
        duration = 0 if self._start is None or self._end is None else self._end - self._start
        return BagMetadata(
            files=(FileEntry(self.path.name, start, duration, self._message_count),),
            topics=tuple(
                TopicEntry(name, channel.type_name, channel.qos, channel.type_hash, count)
                for name, channel in self._channels.items()
                for count in [channel.message_count]
            ),
            start=start,
            duration=duration,
            message_count=self._message_count,
            ros_distro=os.environ.get("ROS_DISTRO") or "jazzy",
            custom_data=self._custom_data,
        )


def _library() -> str:
    try:
        return f"us_sim {version('us_sim')}"
    except PackageNotFoundError:
        return "us_sim"
