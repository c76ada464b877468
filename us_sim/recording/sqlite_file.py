"""Reading one SQLite file of a bag, as rosbag2 wrote by default before ROS 2 Iron."""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Iterator
from contextlib import closing
from pathlib import Path

from us_sim.errors import BagError
from us_sim.recording.qos import qos_from_yaml
from us_sim.recording.schemas import normalized_type
from us_sim.recording.topic import BagMessage, BagTopic

__all__ = ["MAGIC", "SqliteFile"]

MAGIC = b"SQLite format 3\0"


class SqliteFile:
    """One SQLite file as a Storage.

    Args:
        path: the file.
        label: its name in errors, where that is not its path.

    Raises:
        BagError: the file is damaged, or without the tables of rosbag2.
    """

    note = ""

    def __init__(self, path: Path, label: str = "") -> None:
        # Immutable, so that a bag on a read-only disk needs no lock file beside it.
        self._uri = f"{path.resolve().as_uri()}?mode=ro&immutable=1"
        self._label = label or str(path)
        try:
            with closing(sqlite3.connect(self._uri, uri=True)) as database:
                self.topics = tuple(_topics(database, self._label))
                self.start, self.end = database.execute(
                    "SELECT MIN(timestamp), MAX(timestamp) FROM messages"
                ).fetchone()
        except sqlite3.Error as error:
            raise BagError(f"{self._label} cannot be read as a rosbag2 database: {error}") from None

    def messages(self, topics: Collection[str]) -> Iterator[BagMessage]:
        """The messages of these topics in the order of their log times.

        Raises:
            BagError: the database is damaged.
        """
        types = {topic.name: topic.type_name for topic in self.topics if topic.name in topics}
        marks = ",".join("?" * len(types))
        query = (
            "SELECT topics.name, timestamp, data FROM messages "
            "JOIN topics ON topics.id = messages.topic_id "
            f"WHERE topics.name IN ({marks}) ORDER BY timestamp, messages.id"
        )
        try:
            with closing(sqlite3.connect(self._uri, uri=True)) as database:
                for name, time, data in database.execute(query, tuple(types)):
                    yield BagMessage(name, types[name], time, time, data)
        except sqlite3.Error as error:
            raise BagError(f"{self._label} is damaged: {error}") from None


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
