"""The files of a bag, and the reader of each by its first bytes."""

from __future__ import annotations

import os
import re
import shutil
import tempfile
import weakref
from collections.abc import Collection, Iterator
from pathlib import Path, PurePosixPath
from typing import Protocol

from us_sim.errors import BagError
from us_sim.recording import mcap_file, sqlite_file
from us_sim.recording.mcap_file import McapFile
from us_sim.recording.metadata import BagMetadata, read_metadata
from us_sim.recording.sqlite_file import SqliteFile
from us_sim.recording.topic import BagAttachment, BagMessage, BagNote, BagTopic, Fault
from us_sim.recording.unpacking import unpack_file

_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_SUFFIXES = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")
_PART = re.compile(r"(.*?)(?:_(\d+))?(\.(?:mcap|db3)(?:\.zstd)?)")
"""A file of a bag: FOLDER_0.mcap, FOLDER_1.mcap or session.mcap, session_1.mcap and so on."""


class NoBagError(BagError):
    """A file that is of another kind."""


class Storage(Protocol):
    """One readable file of a bag."""

    topics: tuple[BagTopic, ...]
    start: int | None  # ns, lowest log time; None without messages
    end: int | None  # ns, highest log time
    faults: list[Fault]  # that are found without reading its messages

    def messages(
        self, topics: Collection[str], damage: list[Fault] | None = None
    ) -> Iterator[BagMessage]:
        """The messages of these topics in the order of their log times."""
        ...

    def attachments(self, damage: list[Fault] | None = None) -> Iterator[BagAttachment]:
        """The files within it."""
        ...

    def notes(self, damage: list[Fault] | None = None) -> Iterator[BagNote]:
        """The texts beside its messages."""
        ...


class Scratch:
    """A temporary folder for unpacked files, made when needed and removed with this object."""

    def __init__(self) -> None:
        self._folder: str | None = None

    def unpack(self, file: Path) -> Path:
        """A decompressed copy of a zstd file.

        Raises:
            BagError: the file is damaged, or too large for this disk.
        """
        if self._folder is None:
            self._folder = tempfile.mkdtemp(prefix="us_sim_bag_")
            weakref.finalize(self, shutil.rmtree, self._folder, ignore_errors=True)
        copy = Path(self._folder, file.name.removesuffix(".zstd"))
        unpack_file(file, copy)
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
        return [_listed_file(path, file.path) for file in metadata.files], metadata
    files = [file for file in sorted(path.iterdir()) if file.name.endswith(_SUFFIXES)]
    if not files:
        raise BagError(f"{path} holds no bag: neither metadata.yaml nor an .mcap or .db3 file")
    parts = {file: _PART.fullmatch(file.name) for file in files}
    if len({(part[1], part[3]) for part in parts.values() if part}) > 1:
        names = ", ".join(file.name for file in files)
        raise BagError(f"{path} holds several bags and no metadata.yaml: give one of {names}")
    return sorted(files, key=lambda file: int(p[2] or -1) if (p := parts[file]) else 0), None


def open_storage(file: Path, scratch: Scratch) -> Storage:
    """The reader of a file by its first bytes, whatever its name.

    Raises:
        NoBagError: the file is of another kind.
        BagError: the file is empty, a bag of ROS 1, or damaged.
    """
    return _open(file, str(file), scratch)


def _open(file: Path, label: str, scratch: Scratch) -> Storage:
    with file.open("rb") as stream:
        start = stream.read(16)
    if not start:
        raise BagError(f"{label} is empty: its recorder was ended before it wrote anything")
    if start.startswith(mcap_file.MAGIC):
        return McapFile(file, label)
    if start == sqlite_file.MAGIC:
        return SqliteFile(file, label)
    if start.startswith(_ZSTD_MAGIC):
        return _open(scratch.unpack(file), label, scratch)
    if start.startswith(b"#ROSBAG"):
        raise BagError(f"{label} is a bag of ROS 1: convert it with rosbags-convert first")
    raise NoBagError(f"{label} is not a bag: it is neither MCAP nor SQLite, compressed or not")


def _listed_file(folder: Path, listed: str) -> Path:
    """A file that metadata.yaml names; before version 4 its path began with the bag's folder."""
    for file in (folder / listed, folder / PurePosixPath(listed).name):
        if os.path.isfile(file):
            return file
    raise BagError(f"{folder / 'metadata.yaml'} names {listed}, which is not there")
