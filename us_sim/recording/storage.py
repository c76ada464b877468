"""The files of a bag and the readers of them: by their first bytes MCAP, SQLite, or zstd of either.

SQLite is read here and not by rosbags' ``Sqlite3Reader``, which opens a file as immutable: of a
recorder that was killed it leaves out all that is in the journal (``-wal``) beside the file.
"""

from __future__ import annotations

import os
import re
import shutil
import sqlite3
import tempfile
import weakref
from collections.abc import Collection, Iterator
from contextlib import closing
from pathlib import Path, PurePosixPath
from typing import Any

import zstandard
from mcap.writer import MCAP0_MAGIC

from us_sim.errors import BagError
from us_sim.recording.mcap_storage import McapStorage
from us_sim.recording.metadata import BagMetadata, read_metadata
from us_sim.recording.salvage import unpacked_pieces
from us_sim.recording.schemas import normalized_type
from us_sim.recording.topic import (
    BagAttachment,
    BagMessage,
    BagNote,
    BagTopic,
    Fault,
    qos_from_yaml,
)

_SQLITE_MAGIC = b"SQLite format 3\0"


class SqliteFile:
    """One SQLite file as a Storage; errors call it by the label.

    Raises:
        BagError: the file is damaged, or without the tables of rosbag2.
    """

    is_indexed = True

    def __init__(self, path: Path, label: str) -> None:
        self._label = label
        self._uri, unread = _address(path)
        (self.start, self.end, rows, last), *_ = self._rows(
            "SELECT MIN(timestamp) FILTER (WHERE typeof(timestamp) = 'integer'), "
            "MAX(timestamp) FILTER (WHERE typeof(timestamp) = 'integer'), "
            "COUNT(*), MAX(id) FROM messages"
        )
        try:
            with closing(sqlite3.connect(self._uri, uri=True)) as database:
                self.topics = tuple(_topics(database, self._label))
        except (sqlite3.Error, UnicodeDecodeError, TypeError, AttributeError) as error:
            raise self._damaged(error) from None
        self.faults = [Fault(unread)] if unread else []
        if last is not None and last > rows:  # rosbag2 numbers them from 1
            text = (
                f"{self._label} holds {rows} messages, and the last one has the number {last}: "
                f"{last - rows} were lost"
            )
            self.faults.append(Fault(text, last - rows))

    def attachments(
        self,
        damage: list[Fault] | None,  # noqa: ARG002
    ) -> Iterator[BagAttachment]:
        """None: rosbag2 keeps no files in a database."""
        return iter(())

    def notes(self, damage: list[Fault] | None) -> Iterator[BagNote]:  # noqa: ARG002
        """None."""
        return iter(())

    def messages(
        self,
        topics: Collection[str],
        damage: list[Fault] | None,  # noqa: ARG002 (what SQLite finds damaged ends it)
        since: int | None = None,
    ) -> Iterator[BagMessage]:
        """The messages of these topics, since a log time (ns), in the order of their log times.

        Raises:
            BagError: the database is damaged.
        """
        types = {topic.name: topic.type_name for topic in self.topics if topic.name in topics}
        marks = ",".join("?" * len(types))
        query = (
            f"SELECT topics.name, timestamp, data {_JOINED} WHERE topics.name IN ({marks}) "
            "AND timestamp >= ? ORDER BY timestamp, messages.id"
        )
        for name, time, data in self._rows(query, *types, -(2**63) if since is None else since):
            yield self._message(name, types[name], time, data)

    def latest(self, topics: Collection[str], before: int, count: int) -> list[BagMessage]:
        """The last messages of each of these topics before a log time, ns.

        Raises:
            BagError: the database is damaged.
        """
        query = (
            f"SELECT timestamp, data {_JOINED} WHERE topics.name = ? AND timestamp < ? "
            "ORDER BY timestamp DESC, messages.id DESC LIMIT ?"
        )
        found = [
            self._message(topic.name, topic.type_name, time, data)
            for topic in self.topics
            if topic.name in topics
            for time, data in self._rows(query, topic.name, before, count)
        ]
        return found[::-1]

    def _rows(self, query: str, *values: object) -> Iterator[tuple[Any, ...]]:
        try:
            with closing(sqlite3.connect(self._uri, uri=True)) as database:
                yield from database.execute(query, values)
        except (sqlite3.Error, UnicodeDecodeError) as error:
            raise self._damaged(error) from None

    def _message(self, topic: str, type_name: str, time: object, data: object) -> BagMessage:
        if not (isinstance(time, int) and isinstance(data, bytes)):  # SQLite has no checksums
            raise self._damaged(f"a message on {topic} has the time {time!r:.20}, or no data")
        return BagMessage(topic, type_name, time, time, data)

    def _damaged(self, error: object) -> BagError:
        return BagError(f"{self._label} is damaged, or no rosbag2 database: {error}")


_JOINED = "FROM messages JOIN topics ON topics.id = messages.topic_id"


def _address(path: Path) -> tuple[str, str]:
    """The URI of a database, and a sentence on a part of it that cannot be read.

    The last messages are in a journal beside the file (``-wal``) where the recorder was killed.
    """
    uri = f"{path.resolve().as_uri()}?mode=ro"
    # Immutable, so that a bag on a read-only disk needs no lock file beside it.
    unlocked = f"{uri}&immutable=1"
    journal = path.with_name(f"{path.name}-wal")
    try:
        if not (os.path.isfile(journal) and journal.stat().st_size):
            return unlocked, ""
        with closing(sqlite3.connect(uri, uri=True)) as database:
            database.execute("SELECT COUNT(*) FROM sqlite_master").fetchone()
        return uri, ""
    except (sqlite3.Error, OSError) as error:
        return unlocked, (
            f"the part of it in {journal.name} is not read ({error}): copy both files to a folder "
            f"that can be written, and read them there"
        )


def _topics(database: sqlite3.Connection, label: str) -> Iterator[BagTopic]:
    """Topics of a file of any schema version; its columns tell the version."""
    columns = {row[1] for row in database.execute("PRAGMA table_info(topics)")}
    qos = "offered_qos_profiles" if "offered_qos_profiles" in columns else "''"
    type_hash = "type_description_hash" if "type_description_hash" in columns else "''"
    schemas: dict[str, str] = {}
    if database.execute("PRAGMA table_info(message_definitions)").fetchone():
        schemas = dict(
            database.execute(
                "SELECT topic_type, encoded_message_definition FROM message_definitions "
                "WHERE encoding = 'ros2msg'"
            )
        )
    rows = database.execute(
        f"SELECT name, type, serialization_format, {qos}, {type_hash}, COUNT(messages.id) "
        "FROM topics LEFT JOIN messages ON messages.topic_id = topics.id "
        "GROUP BY topics.id ORDER BY topics.id"
    )
    for name, type_name, encoding, profiles, digest, count in rows:
        yield BagTopic(
            name=name,
            type_name=normalized_type(type_name),
            message_count=count,
            qos=qos_from_yaml(profiles, f"{label}, {name}"),
            type_hash=digest or "",
            encoding=encoding,
            schema=schemas.get(type_name),
        )


_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_SUFFIXES = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")
_PART = re.compile(r"(?P<name>.*?)(?:_(?P<part>\d+))?(?P<kind>\.(?:mcap|db3)(?:\.zstd)?)")
"""A file of a bag: FOLDER_0.mcap, FOLDER_1.mcap or session.mcap, session_1.mcap and so on."""
_DATED_PART = re.compile(
    r"(?P<part>\d+)_(?P<name>.+)_\d{4}(?:_\d\d){2}-\d\d(?:_\d\d){2}"
    r"(?P<kind>\.(?:mcap|db3)(?:\.zstd)?)"
)
"""A file as the rosbag2 of ROS 2 Lyrical calls it: 0_FOLDER_2026_06_24-10_00_00.mcap."""


Storage = McapStorage | SqliteFile


class NoBagError(BagError):
    """A file that is of another kind."""


class Scratch:
    """A temporary folder for unpacked files, made when needed and removed with this object."""

    def __init__(self) -> None:
        self._folder: str | None = None

    def unpack(self, file: Path) -> Path:
        """A decompressed copy of a zstd file; of one that is cut off, of the bytes before the cut.

        Raises:
            BagError: the file is damaged.
        """
        if self._folder is None:
            self._folder = tempfile.mkdtemp(prefix="us_sim_bag_")
            weakref.finalize(self, shutil.rmtree, self._folder, ignore_errors=True)
        copy = Path(self._folder, file.name.removesuffix(".zstd"))
        try:
            with file.open("rb") as packed, copy.open("wb") as unpacked:
                unpacked.writelines(unpacked_pieces(packed))
        except zstandard.ZstdError as error:
            raise BagError(f"{file} cannot be decompressed: {error}") from None
        return copy


def bag_files(path: Path) -> tuple[list[Path], BagMetadata | None]:
    """The files that a bag consists of, in their order, and its ``metadata.yaml`` if it has one.

    Raises:
        BagError: there are none, some are missing, or several could be meant.
    """
    if os.path.isfile(path):
        return [path], None
    if not os.path.isdir(path):
        raise BagError(f"there is no bag at {path}: give an .mcap or .db3 file, or a bag's folder")
    if os.path.isfile(path / "metadata.yaml"):
        metadata = read_metadata(path / "metadata.yaml")
        found = [_listed_file(path, file.path) for file in metadata.files]
        if metadata.files and not any(found):
            names = ", ".join(file.path for file in metadata.files)
            raise BagError(f"{path / 'metadata.yaml'} names {names}, which is not there")
        return [file for file in found if file is not None], metadata
    files = [file for file in sorted(path.iterdir()) if file.name.endswith(_SUFFIXES)]
    if not files:
        raise BagError(f"{path} holds no bag: neither metadata.yaml nor an .mcap or .db3 file")
    parts = {file: _DATED_PART.fullmatch(file.name) or _PART.fullmatch(file.name) for file in files}
    if len({(part["name"], part["kind"]) for part in parts.values() if part}) > 1:
        names = ", ".join(file.name for file in files)
        raise BagError(f"{path} holds several bags and no metadata.yaml: give one of {names}")
    return sorted(files, key=lambda file: int(p["part"] or -1) if (p := parts[file]) else 0), None


def open_storage(file: Path, scratch: Scratch, label: str = "") -> Storage:
    """The reader of a file by its first bytes, whatever its name; errors name it, or the label.

    Raises:
        NoBagError: the file is of another kind.
        BagError: the file is empty, a bag of ROS 1, or damaged.
    """
    label = label or str(file)
    with file.open("rb") as stream:
        start = stream.read(16)
    if not start:
        raise BagError(f"{label} is empty: its recorder was ended before it wrote anything")
    if start.startswith(MCAP0_MAGIC):
        return McapStorage(file, label)
    if start == _SQLITE_MAGIC:
        return SqliteFile(file, label)
    if start.startswith(_ZSTD_MAGIC):
        copy = scratch.unpack(file)
        if not copy.stat().st_size:
            raise BagError(f"{label} is cut before anything of it can be unpacked: copy it again")
        return open_storage(copy, scratch, label)
    if start.startswith(b"#ROSBAG"):
        raise BagError(f"{label} is a bag of ROS 1: convert it with rosbags-convert first")
    raise NoBagError(f"{label} is not a bag: it is neither MCAP nor SQLite, compressed or not")


def missing_files(folder: Path, metadata: BagMetadata) -> list[str]:
    """Return the names of the files that metadata.yaml lists and the folder lacks."""
    return [file.path for file in metadata.files if _listed_file(folder, file.path) is None]


def _listed_file(folder: Path, listed: str) -> Path | None:
    """Return a file that metadata.yaml names, if it is there.

    Before version 4 its path began with the bag's folder.
    """
    for file in (folder / listed, folder / PurePosixPath(listed).name):
        if os.path.isfile(file):
            return file
    return None
