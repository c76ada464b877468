"""Reading one SQLite file of a bag, as rosbag2 wrote by default before ROS 2 Iron."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Collection, Iterator
from contextlib import closing
from pathlib import Path

from us_sim.errors import BagError
from us_sim.recording.qos import qos_from_yaml
from us_sim.recording.schemas import normalized_type
from us_sim.recording.topic import BagAttachment, BagMessage, BagNote, BagTopic, Fault

MAGIC = b"SQLite format 3\0"


class SqliteFile:
    """One SQLite file as a Storage.

    Args:
        path: the file.
        label: its name in errors, where that is not its path.

    Raises:
        BagError: the file is damaged, or without the tables of rosbag2.
    """

    def __init__(self, path: Path, label: str = "") -> None:
        self._label = label or str(path)
        self._uri, unread = _address(path)
        try:
            with closing(sqlite3.connect(self._uri, uri=True)) as database:
                _check_tables(database)
                self.topics = tuple(_topics(database, self._label))
                self.start, self.end, rows, last = database.execute(
                    "SELECT MIN(timestamp) FILTER (WHERE typeof(timestamp) = 'integer'), "
                    "MAX(timestamp) FILTER (WHERE typeof(timestamp) = 'integer'), "
                    "COUNT(*), MAX(id) FROM messages"
                ).fetchone()
        except _DAMAGE as error:
            raise BagError(f"{self._label} cannot be read as a rosbag2 database: {error}") from None
        usable = sum(topic.message_count for topic in self.topics)
        self.faults = [Fault(unread)] if unread else []
        if usable < rows:
            text = (
                f"{rows - usable} of the {rows} messages of {self._label} have no whole number as "
                f"their time, no data or no topic, and are left out"
            )
            self.faults.append(Fault(text, rows - usable))
        if last is not None and last > rows:  # rosbag2 numbers them from 1
            text = (
                f"{self._label} holds {rows} messages, and the last one has the number {last}: "
                f"{last - rows} were lost"
            )
            self.faults.append(Fault(text, last - rows))

    def attachments(
        self,
        damage: list[Fault] | None = None,  # noqa: ARG002
    ) -> Iterator[BagAttachment]:
        """None: rosbag2 keeps no files in a database."""
        return iter(())

    def notes(self, damage: list[Fault] | None = None) -> Iterator[BagNote]:  # noqa: ARG002
        """None."""
        return iter(())

    def messages(
        self,
        topics: Collection[str],
        damage: list[Fault] | None = None,  # noqa: ARG002 (what SQLite finds damaged ends it)
    ) -> Iterator[BagMessage]:
        """The messages of these topics in the order of their log times.

        Raises:
            BagError: the database is damaged.
        """
        types = {topic.name: topic.type_name for topic in self.topics if topic.name in topics}
        marks = ",".join("?" * len(types))
        query = (
            "SELECT topics.name, timestamp, data FROM messages "
            "JOIN topics ON topics.id = messages.topic_id "
            f"WHERE topics.name IN ({marks}) AND {_USABLE} ORDER BY timestamp, messages.id"
        )
        try:
            with closing(sqlite3.connect(self._uri, uri=True)) as database:
                for name, time, data in database.execute(query, tuple(types)):
                    yield BagMessage(name, types[name], time, time, data)
        except _DAMAGE as error:
            raise BagError(f"{self._label} is damaged: {error}") from None


_DAMAGE = (sqlite3.Error, UnicodeDecodeError, TypeError, AttributeError, MemoryError)
"""Errors that a damaged database gives."""

_USABLE = "typeof(timestamp) = 'integer' AND typeof(data) = 'blob'"


def _address(path: Path) -> tuple[str, str]:
    """The URI of a database, and what of it cannot be read.

    What was recorded last is in a journal beside the file (``-wal``) where the recorder was killed.
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
            f"what {journal.name} holds of it is not read ({error}): copy both files to a folder "
            f"that can be written, and read them there"
        )


def _check_tables(database: sqlite3.Connection) -> None:
    """Refuse tables that are queries in truth, which may never end."""
    kinds = dict(database.execute("SELECT name, type FROM sqlite_master WHERE type <> 'index'"))
    for name in ("topics", "messages"):
        if kinds.get(name) != "table":
            raise sqlite3.DatabaseError(f"it has no table {name}")


def _topics(database: sqlite3.Connection, label: str) -> Iterator[BagTopic]:
    """Topics of a file of any schema version; the columns tell what it carries."""
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
        f"FROM topics LEFT JOIN messages ON messages.topic_id = topics.id AND {_USABLE} "
        "GROUP BY topics.id ORDER BY topics.id"
    )
    for name, type_name, encoding, profiles, digest, count in rows:
        if not all(isinstance(text, str) for text in (name, type_name, encoding)):
            raise sqlite3.DatabaseError(f"topic {name!r} has no name, type or encoding")
        yield BagTopic(
            name=name,
            type_name=normalized_type(type_name),
            message_count=count,
            qos=qos_from_yaml(profiles, f"{label}, {name}"),
            type_hash=digest or "",
            encoding=encoding,
            schema=schemas.get(type_name),
        )
