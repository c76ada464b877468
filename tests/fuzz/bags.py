"""Bags, and paths of a probe in them."""

from __future__ import annotations

import io
import itertools
import sqlite3
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
import zstandard
from mcap.writer import CompressionType, Writer

from tests.fuzz.target import target
from us_sim.errors import UsSimError
from us_sim.recording.metadata import read_metadata
from us_sim.recording.path import ProbePath, read_path, write_path
from us_sim.recording.reader import describe, read_bag
from us_sim.recording.topic import QosProfile, qos_to_yaml
from us_sim.recording.writer import BagWriter

EPOCH = 1_700_000_000_000_000_000
POSE = "geometry_msgs/msg/PoseStamped"
STEPS = np.arange(8)
PATH = ProbePath(
    "/tracker/pose",
    "patient",
    EPOCH + 16_666_667 * STEPS,
    np.outer(STEPS, [0.0, 1e-3, 2e-3]),
    np.tile([0.0, 0.0, 0.0, 1.0], (len(STEPS), 1)),
)
MOST = 200
"""Messages of a bag that are read."""


def read_all(path: Path) -> None:
    """All that a command or a node asks of a bag."""
    bag = read_bag(path)
    describe(bag)
    for message in itertools.islice(bag.messages(), MOST):
        assert isinstance(message.data, bytes)
        with suppress(UsSimError):
            bag.deserialize(message)
    poses = read_path(path)
    assert len(poses)
    assert np.isfinite(poses.positions).all()
    assert np.linalg.norm(poses.orientations, axis=1).min() > 0
    poses.pose(0)


def mcap_seeds(folder: Path) -> Iterator[bytes]:
    """As this package writes it, and without the checksums that keep changes from the readers."""
    for compression in ("none", "zstd"):
        file = folder / f"{compression}.mcap"
        with BagWriter(file, compression=compression, chunk_size=700, sidecar=False) as bag:
            bag.add_topic(PATH.topic, POSE, [QosProfile(depth=1, durability="transient_local")])
            bag.add_topic("/note", "std_msgs/msg/String")
            for message in poses(folder):
                bag.write(PATH.topic, message.data, message.log_time, message.publish_time)
                bag.write("/note", bytes.fromhex("0001000003000000686900"), message.log_time)
        yield file.read_bytes()
    for compression in CompressionType:
        yield unchecked(folder, compression)


def poses(folder: Path) -> list:
    """The messages of the path."""
    file = folder / "path.mcap"
    if not file.exists():
        write_path(file, PATH, sidecar=False)
    return list(read_bag(file).messages())


def unchecked(folder: Path, compression: CompressionType) -> bytes:
    """A file without checksums by the mcap package."""
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=700, compression=compression, enable_crcs=False)
    writer.start(profile="ros2")
    text = read_bag(folder / "path.mcap").topic(PATH.topic).schema if poses(folder) else ""
    schema = writer.register_schema(POSE, "ros2msg", text.encode())
    qos = {"offered_qos_profiles": qos_to_yaml([QosProfile()])}
    channel = writer.register_channel(PATH.topic, "cdr", schema, metadata=qos)
    for message in poses(folder):
        writer.add_message(channel, message.log_time, message.data, message.publish_time)
    writer.finish()
    return stream.getvalue()


target("mcap", ".mcap", mcap_seeds)(read_all)


def packed_seeds(folder: Path) -> Iterator[bytes]:
    """The same, packed as a file."""
    for seed in mcap_seeds(folder):
        yield zstandard.ZstdCompressor().compress(seed)


target("mcap-zstd", ".mcap.zstd", packed_seeds)(read_all)


def sqlite_seeds(folder: Path) -> Iterator[bytes]:
    """Bags of two versions of rosbag2's tables."""
    for columns in ("", ", offered_qos_profiles TEXT, type_description_hash TEXT"):
        file = folder / f"bag{len(columns)}.db3"
        with closing(sqlite3.connect(file)) as database:
            database.executescript(
                "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, "
                f"serialization_format TEXT{columns});"
                "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, "
                "timestamp INTEGER, data BLOB);"
                "CREATE INDEX timestamp_idx ON messages (timestamp ASC);"
            )
            row = [1, PATH.topic, POSE, "cdr", qos_to_yaml([QosProfile()]), "RIHS01_00"]
            row = row[: 6 if columns else 4]
            database.execute(f"INSERT INTO topics VALUES({','.join('?' * len(row))})", row)
            database.executemany(
                "INSERT INTO messages(topic_id, timestamp, data) VALUES(1, ?, ?)",
                [(message.log_time, message.data) for message in poses(folder)],
            )
            database.commit()
        yield file.read_bytes()


target("sqlite", ".db3", sqlite_seeds)(read_all)


def metadata_seeds(folder: Path) -> Iterator[bytes]:
    """The file beside a bag."""
    with BagWriter(folder / "bag") as bag:
        bag.add_topic(PATH.topic, POSE, [QosProfile()])
        for message in poses(folder):
            bag.write(PATH.topic, message.data, message.log_time)
    yield (folder / "bag" / "metadata.yaml").read_bytes()


target("metadata", ".yaml", metadata_seeds)(read_metadata)
