"""The files of a bag and the readers of them: by their first bytes MCAP or SQLite."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from mcap.records import Attachment, Metadata
from mcap.writer import MCAP0_MAGIC
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

from us_sim.errors import BagError
from us_sim.recording.mcap_storage import McapStorage
from us_sim.recording.schemas import normalize_type
from us_sim.recording.topic import BagMessage, BagTopic

_SQLITE_MAGIC = b"SQLite format 3\0"
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_SUFFIXES = (".mcap", ".db3")
_NUMBERS = re.compile(r"^\d+_|_[\d_-]+(?=\.)")
"""Parts that tell a bag's files apart: BAG_1.mcap, or 1_BAG_2026_06_24-10_00_00.mcap in Lyrical."""


class SqliteStorage:
    """One SQLite file as a Storage, by rosbags.

    Raises:
        BagError: the file is damaged, or without the tables of rosbag2.
    """

    # rosbag2 keeps neither files nor notes in a database
    attachments: tuple[Attachment, ...] = ()
    notes: tuple[Metadata, ...] = ()

    def __init__(self, path: Path) -> None:
        self._path = path
        self.fault = ""
        journal = path.with_name(f"{path.name}-wal")
        if os.path.isfile(journal) and journal.stat().st_size:
            self.fault = (
                f"{path} was not closed by its recorder, and what is in {journal.name} is not "
                f"read: `sqlite3 {path} 'PRAGMA wal_checkpoint'` puts it into the file"
            )
        self._reader = Sqlite3Reader(path)
        try:
            self._reader.open()
            self.topics = [_topic(each) for each in self._reader.connections]
            about = self._reader.metadata
            self.start = int(about.start_time) if about.message_count else None
            self.end = int(about.end_time) - 1 if about.message_count else None
        except Exception as error:  # rosbags' own, SQLite's, and what foreign texts lead to
            raise self._damaged(error) from None

    def read_messages(
        self, topics: Collection[str], _: list[str] | None, since: int | None
    ) -> Iterator[BagMessage]:
        """Yield the messages of these topics, since a log time (ns), in the order of log times.

        Raises:
            BagError: the database is damaged.
        """
        wanted = [each for each in self._reader.connections if each.topic in topics]
        try:
            for connection, time, data in self._reader.messages(wanted, since):
                type_name = normalize_type(connection.msgtype)
                yield BagMessage(connection.topic, type_name, int(time), int(time), bytes(data))
        except Exception as error:
            raise self._damaged(error) from None

    def _damaged(self, error: Exception) -> BagError:
        text = f"{self._path} is damaged, or no rosbag2 database: {error}"
        return BagError("; ".join(filter(None, [text, self.fault])))


def _topic(connection: Any) -> BagTopic:
    definition = connection.msgdef
    return BagTopic(
        name=connection.topic,
        type_name=normalize_type(connection.msgtype),
        message_count=connection.msgcount,
        qos=tuple(connection.ext.offered_qos_profiles),
        type_hash=connection.digest or "",
        encoding=connection.ext.serialization_format,
        schema=definition.data if definition.format.name == "MSG" else None,
    )


Storage = McapStorage | SqliteStorage


def find_bag_files(path: Path) -> list[Path]:
    """Find the files that a bag consists of.

    Raises:
        BagError: there are none, or several bags could be meant.
    """
    if os.path.isfile(path):
        return [path]
    if not os.path.isdir(path):
        raise BagError(f"there is no bag at {path}: give an .mcap or .db3 file, or a bag's folder")
    files = [file for file in sorted(path.iterdir()) if file.name.endswith(_SUFFIXES)]
    if not files:
        raise BagError(f"{path} holds no bag: no .mcap or .db3 file (`zstd -d` unpacks .zstd)")
    if len({_NUMBERS.sub("", file.name) for file in files}) > 1:
        names = ", ".join(file.name for file in files)
        raise BagError(f"{path} holds several bags: give one of {names}")
    return files


def open_storage(file: Path) -> Storage:
    """Open a file by its first bytes, whatever its name.

    Raises:
        BagError: the file is empty, a bag of ROS 1, damaged, or of another kind.
    """
    with file.open("rb") as stream:
        start = stream.read(16)
    if not start:
        raise BagError(f"{file} is empty: its recorder was ended before it wrote anything")
    if start.startswith(MCAP0_MAGIC):
        return McapStorage(file)
    if start == _SQLITE_MAGIC:
        return SqliteStorage(file)
    if start.startswith(_ZSTD_MAGIC):
        raise BagError(f"{file} is packed: `zstd -d` unpacks it")
    if start.startswith(b"#ROSBAG"):
        raise BagError(f"{file} is a bag of ROS 1: convert it with rosbags-convert first")
    raise BagError(
        f"{file} is not a bag, neither MCAP nor SQLite: give one, or for poses a tracker recording "
        f"of PLUS (.igs.mha, .igs.nrrd)"
    )
