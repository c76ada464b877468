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
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import Literal

from us_sim.errors import BagError
from us_sim.recording.contents import Contents
from us_sim.recording.mcap_output import McapOutput

__all__ = ["BagWriter"]

_CHUNK_SIZE = 768 * 1024  # bytes, rosbag2's default
_ROOM = 16 * 1024 * 1024  # bytes, that must be free again before a full disk is written to
_COMPRESSIONS = {"none": "", "zstd": "zstd"}


class BagWriter:
    """Writes one bag: an MCAP file or several, and when it is closed, its ``metadata.yaml``.

    A message reaches the operating system at the latest when one comes that is a second younger,
    or with :meth:`flush`, and then survives the end of the process.

    Where the disk is full the file gets its index and is closed, :meth:`resume` goes on in another
    one when there is room again, and :attr:`lost` tells what did not fit.

    Args:
        path: ``FILE.mcap``, with ``metadata.yaml`` in the same folder; or a new folder, in which
            the file is called ``FOLDER_0.mcap`` as rosbag2 does. Missing folders are made. Further
            files are called ``FILE_1.mcap`` or ``FOLDER_1.mcap`` and so on.
        compression: of the chunks, ``"none"`` or ``"zstd"``.
        chunk_size: bytes after which a chunk is ended.
        flush_interval: s of log time after which everything is handed to the operating system.
        max_size: bytes after which a further file is begun; 0 for never.
        max_duration: s after which a further file is begun; 0 for never.
        sidecar: False leaves ``metadata.yaml`` away, for folders with several one-file bags.
        further: where ``FILE.mcap`` exists, go on in ``FILE_1.mcap`` or the next that is free. No
            ``metadata.yaml`` is written then: it would have to speak for files that are not this
            writer's.
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
        max_size: int = 0,
        max_duration: float = 0.0,
        sidecar: bool = True,
        further: bool = False,
        custom_data: Mapping[str, str] | None = None,
    ) -> None:
        if compression not in _COMPRESSIONS:
            raise BagError(f"chunks cannot be compressed with {compression!r}: use none or zstd")
        self.custom_data = dict(custom_data or {})
        self.lost: Counter[str] = Counter()  # messages that the disk did not take, by topic
        self.on_split: Callable[[str, str], None] | None = None
        self._metadata_file: Path | None = None
        self._compression, self._chunk_size = _COMPRESSIONS[compression], chunk_size
        self._flush_interval = round(flush_interval * 1e9)
        self._max_size, self._max_duration = max_size, round(max_duration * 1e9)
        self._contents = Contents()
        self._attachments: dict[str, tuple[str, bytes, int]] = {}
        self._last_flush: int | None = None
        self._closed_because = ""
        self._ended = False
        try:
            self._begin(Path(path), sidecar=sidecar, further=further)
        except OSError as error:
            raise BagError(f"{path} cannot be made: {error.strerror}") from None
        except ValueError as error:  # a name that no file can have
            raise BagError(f"{path} cannot be made: {error}") from None

    @property
    def message_count(self) -> int:
        """Number of messages written."""
        present = 0 if self._is_finished else self._output.message_count
        return sum(file.message_count for file in self._contents.files) + present

    @property
    def topics(self) -> tuple[str, ...]:
        """Names of the topics added."""
        return self._contents.topics

    def add_topic(
        self,
        topic: str,
        type_name: str,
        qos: Sequence[object] = (),
        type_hash: str | None = None,
        *,
        schema: str | None = None,
    ) -> None:
        """Makes a topic known; adding it again with the same type adds what is offered anew.

        Args:
            topic: full name.
            type_name: ``package/msg/Type``.
            qos: what its publishers offer, in any form that ``QosProfile.of`` takes. What is added
                later is in ``metadata.yaml`` and in files begun after that.
            type_hash: RIHS01 hash; computed from the definition by default.
            schema: ``ros2msg`` text; the installed or the Jazzy definition by default.

        Raises:
            BagError: the type is unknown, differs from before, or the bag is closed.
        """
        if self._ended:
            raise BagError(self._closed_because)
        if self._contents.add_topic(topic, type_name, qos, type_hash, schema):
            self._contents.introduce(topic, self._output)

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
                full; what was written before stays readable.
        """
        if topic not in self._contents:
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
            self._output.add_message(
                topic,
                log_time_ns,
                publish_time_ns,
                sequence & 0xFFFFFFFF,
                bytes(cdr),
            )
        if self._last_flush is None:
            self._last_flush = log_time_ns
        elif log_time_ns - self._last_flush >= self._flush_interval:
            self.flush()
            self._last_flush = log_time_ns

    def attach(self, name: str, media_type: str, data: bytes, time_ns: int) -> None:
        """Puts a file into each of the bag's, such as the scene that is recorded.

        Args:
            name: of the file.
            media_type: such as ``text/plain``.
            data: its content.
            time_ns: ns since the epoch, when it was as it is.

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
        """
        with self._writing():
            self._output.end_chunk()

    def split(self) -> None:
        """Ends the present file and goes on in a further one.

        Raises:
            BagError: the bag is closed, or the disk is full.
        """
        with self._writing():
            self._add_metadata(self._output)
            closed = self._output.path
            self._finish()
            self._output = self._opened(self._further())
        if self.on_split is not None:
            self.on_split(str(closed), str(self._output.path))

    def resume(self) -> bool:
        """After the disk was full: whether there is room again, and a further file is begun."""
        if self._closed_because and shutil.disk_usage(self.path.parent).free >= _ROOM:
            with contextlib.suppress(OSError):
                self._output = self._opened(self._further())
                self._closed_because = ""
        return not self._closed_because

    def close(self) -> None:
        """Writes the index and ``metadata.yaml``; closing again does nothing.

        Raises:
            BagError: the disk is full; what was written before stays readable.
        """
        self._ended = True
        if not self._closed_because:
            with self._writing():
                self._add_metadata(self._output)
                self._finish()
            self._closed_because = f"{self.path} is closed: nothing can be written to it any more"
            if self.on_split is not None:
                self.on_split(str(self._output.path), "")
        if self._metadata_file is None:
            return
        metadata_file, self._metadata_file = self._metadata_file, None
        try:
            with metadata_file.open("x", encoding="utf-8") as file:
                file.write(self._contents.metadata(None, self.custom_data).document())
        except OSError as error:
            with contextlib.suppress(OSError):
                if not isinstance(error, FileExistsError):
                    metadata_file.unlink()
            raise BagError(
                f"{metadata_file} cannot be written ({error.strerror}): the recording can be read "
                f"without it, and `ros2 bag reindex -s mcap {metadata_file.parent}` makes it"
            ) from None

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _begin(self, path: Path, *, sidecar: bool, further: bool) -> None:
        """Make the first file."""
        is_folder = path.suffix != ".mcap"
        self._stem = path.resolve().name if is_folder else path.stem
        self.path = path / f"{self._stem}_0.mcap" if is_folder else path
        if further and self.path.exists():
            self.path = self._further()
        else:
            self._metadata_file = self.path.with_name("metadata.yaml") if sidecar else None
            self._refuse_to_overwrite(is_folder=is_folder, folder=path)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._output = self._opened(self.path)

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

    @property
    def _is_finished(self) -> bool:
        """Whether the present file has been closed."""
        files = self._contents.files
        return bool(files) and files[-1].path == self._output.path.name

    def _is_long(self, time: int) -> bool:
        """Whether the file is as large or long as one may be, before a message of that time."""
        file = self._output
        if self._max_size and file.size >= self._max_size:
            return True
        late = file.start is not None and time - file.start > self._max_duration
        return bool(self._max_duration and late)

    def _further(self) -> Path:
        """The next file's name."""
        numbers = count(1)
        while True:
            path = self.path.with_name(f"{self._stem}_{next(numbers)}.mcap")
            if not path.exists():
                return path

    def _opened(self, path: Path) -> McapOutput:
        """A new file that knows all topics so far, with what is attached."""
        output = McapOutput(
            path, _library(), compression=self._compression, chunk_size=self._chunk_size
        )
        for topic in self.topics:
            self._contents.introduce(topic, output)
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
        """Turns a failure of the disk into an error that says what is kept, and stops there."""
        if self._closed_because:
            raise BagError(self._closed_because)
        try:
            yield
        except OSError as error:
            with contextlib.suppress(OSError):
                self._finish()
            self._closed_because = (
                f"{self._output.path} cannot be written ({error.strerror}): the recording stops, "
                f"and its first {self.message_count} messages are kept and can be read"
            )
            raise BagError(self._closed_because) from None

    def _finish(self) -> None:
        """Give the present file its index, close it and count what is in it."""
        if self._is_finished:
            return
        try:
            self._output.finish()
        finally:
            self._contents.keep(self._output)
            self.lost += self._output.dropped

    def _add_metadata(self, output: McapOutput) -> None:
        lines = self._contents.metadata(output, self.custom_data).lines()
        output.add_metadata("rosbag2", {"serialized_metadata": "\n".join(lines)})


def _library() -> str:
    try:
        return f"us_sim {version('us_sim')}"
    except PackageNotFoundError:
        return "us_sim"
