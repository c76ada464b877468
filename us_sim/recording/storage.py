"""The files of a bag and the readers of them: by their first bytes MCAP, SQLite, or zstd."""

from __future__ import annotations

import os
import re
import shutil
import tempfile
import weakref
from collections.abc import Collection, Iterator
from pathlib import Path, PurePosixPath
from typing import Any

import zstandard
from mcap.records import Attachment, Metadata
from mcap.writer import MCAP0_MAGIC
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

from us_sim.errors import BagError
from us_sim.recording.mcap_storage import McapStorage
from us_sim.recording.metadata import BagMetadata, read_metadata
from us_sim.recording.schemas import normalized_type
from us_sim.recording.topic import BagMessage, BagTopic, Fault

_SQLITE_MAGIC = b"SQLite format 3\0"
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_SUFFIXES = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")
_NUMBERS = re.compile(r"^\d+_|_[\d_-]+(?=\.)")
"""What tells the files of a bag apart: BAG_1.mcap, or 1_BAG_2026_06_24-10_00_00.mcap in Lyrical."""


class SqliteStorage:
    """One SQLite file as a Storage, by rosbags; errors call it by the label.

    Raises:
        BagError: the file is damaged, or without the tables of rosbag2.
    """

    is_indexed = True
    # rosbag2 keeps neither files nor notes in a database
    attachments: tuple[Attachment, ...] = ()
    damaged_attachments: tuple[Fault, ...] = ()
    notes: tuple[Metadata, ...] = ()

    def __init__(self, path: Path, label: str) -> None:
        self._label = label
        self.faults: list[Fault] = []
        journal = path.with_name(f"{path.name}-wal")
        if os.path.isfile(journal) and journal.stat().st_size:
            text = (
                f"{label} was not closed by its recorder, and what is in {journal.name} is not "
                f"read: `sqlite3 {path} 'PRAGMA wal_checkpoint'` puts it into the file"
            )
            self.faults.append(Fault(text))
        self._reader = Sqlite3Reader(path)
        try:
            self._reader.open()
            self.topics = [_topic(each) for each in self._reader.connections]
            about = self._reader.metadata
            self.start = int(about.start_time) if about.message_count else None
            self.end = int(about.end_time) - 1 if about.message_count else None
        except Exception as error:  # rosbags' own, SQLite's, and what foreign texts lead to
            raise self._damaged(error) from None

    def messages(
        self, topics: Collection[str], _: list[Fault] | None, since: int | None = None
    ) -> Iterator[BagMessage]:
        """Yield the messages of these topics, since a log time (ns), in the order of log times.

        Raises:
            BagError: the database is damaged.
        """
        wanted = [each for each in self._reader.connections if each.topic in topics]
        try:
            for connection, time, data in self._reader.messages(wanted, since):
                type_name = normalized_type(connection.msgtype)
                yield BagMessage(connection.topic, type_name, int(time), int(time), bytes(data))
        except Exception as error:
            raise self._damaged(error) from None

    def _damaged(self, error: Exception) -> BagError:
        text = f"{self._label} is damaged, or no rosbag2 database: {error}"
        return BagError("; ".join([text, *(fault.text for fault in self.faults)]))


def _topic(connection: Any) -> BagTopic:
    definition = connection.msgdef
    return BagTopic(
        name=connection.topic,
        type_name=normalized_type(connection.msgtype),
        message_count=connection.msgcount,
        qos=tuple(connection.ext.offered_qos_profiles),
        type_hash=connection.digest or "",
        encoding=connection.ext.serialization_format,
        schema=definition.data if definition.format.name == "MSG" else None,
    )


Storage = McapStorage | SqliteStorage


def _open_packed(file: Path) -> Storage:
    """Open a zstd file; of one that is cut off, of the bytes before the cut.

    Its decompressed copy is removed with the reader.
    """
    folder = tempfile.mkdtemp(prefix="us_sim_bag_")
    copy = Path(folder, file.name.removesuffix(".zstd"))
    try:
        with file.open("rb") as packed, copy.open("wb") as unpacked:
            frames = zstandard.ZstdDecompressor()
            with frames.stream_reader(packed, read_across_frames=True) as reader:
                shutil.copyfileobj(reader, unpacked, 1 << 20)
        if not copy.stat().st_size:
            raise BagError(f"{file} is cut before anything of it can be unpacked: copy it again")
        storage = open_storage(copy, str(file))
    except BaseException as error:
        shutil.rmtree(folder, ignore_errors=True)
        if isinstance(error, zstandard.ZstdError):
            raise BagError(f"{file} cannot be decompressed: {error}") from None
        raise
    weakref.finalize(storage, shutil.rmtree, folder, ignore_errors=True)
    return storage


def bag_files(path: Path) -> tuple[list[Path], BagMetadata | None]:
    """Find the files that a bag consists of, and its ``metadata.yaml`` if it has one.

    Raises:
        BagError: there are none, or several bags could be meant.
    """
    if os.path.isfile(path):
        return [path], None
    if not os.path.isdir(path):
        raise BagError(f"there is no bag at {path}: give an .mcap or .db3 file, or a bag's folder")
    if os.path.isfile(path / "metadata.yaml"):
        metadata = read_metadata(path / "metadata.yaml")
        found = [_listed_file(path, file) for file in metadata.files]
        if metadata.files and not any(found):
            names = ", ".join(metadata.files)
            raise BagError(f"{path / 'metadata.yaml'} names {names}, which is not there")
        return [file for file in found if file is not None], metadata
    files = [file for file in sorted(path.iterdir()) if file.name.endswith(_SUFFIXES)]
    if not files:
        raise BagError(f"{path} holds no bag: neither metadata.yaml nor an .mcap or .db3 file")
    if len({_NUMBERS.sub("", file.name) for file in files}) > 1:
        names = ", ".join(file.name for file in files)
        raise BagError(f"{path} holds several bags and no metadata.yaml: give one of {names}")
    return files, None


def open_storage(file: Path, label: str = "") -> Storage:
    """Open a file by its first bytes, whatever its name; errors name it, or the label.

    Raises:
        BagError: the file is empty, a bag of ROS 1, damaged, or of another kind.
    """
    label = label or str(file)
    with file.open("rb") as stream:
        start = stream.read(16)
    if not start:
        raise BagError(f"{label} is empty: its recorder was ended before it wrote anything")
    if start.startswith(MCAP0_MAGIC):
        return McapStorage(file, label)
    if start == _SQLITE_MAGIC:
        return SqliteStorage(file, label)
    if start.startswith(_ZSTD_MAGIC):
        return _open_packed(file)
    if start.startswith(b"#ROSBAG"):
        raise BagError(f"{label} is a bag of ROS 1: convert it with rosbags-convert first")
    raise BagError(
        f"{label} is not a bag, neither MCAP nor SQLite, compressed or not: give one, or for poses "
        f"a tracker recording of PLUS (.igs.mha, .igs.nrrd)"
    )


def missing_files(folder: Path, metadata: BagMetadata) -> list[str]:
    """Return the names of the files that metadata.yaml lists and the folder lacks."""
    return [file for file in metadata.files if _listed_file(folder, file) is None]


def _listed_file(folder: Path, listed: str) -> Path | None:
    """Return a file that metadata.yaml names, if it is there.

    Before version 4 its path began with the bag's folder.
    """
    for file in (folder / listed, folder / PurePosixPath(listed).name):
        if os.path.isfile(file):
            return file
    return None
