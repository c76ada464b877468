"""Repairing a recording: all that can be read of it, in a new bag; and its attached files."""

from __future__ import annotations

import hashlib
import os
import platform
import sys
from dataclasses import dataclass
from importlib.metadata import distributions
from pathlib import Path
from typing import BinaryIO

from us_sim.errors import BagError
from us_sim.recording.reader import read_bag
from us_sim.recording.topic import Fault
from us_sim.recording.writer import BagWriter


def extract(bag: Path, folder: Path) -> list[Path]:
    """Write the files that are attached to a bag; return their paths.

    Raises:
        BagError: it has none, a name is no file's, a file is there already, or cannot be written;
            or one is damaged, and all others are written.
    """
    source = read_bag(bag)
    attached, damage = source.attachments, source.damaged_attachments
    if not attached and not damage:
        raise BagError(f"{bag} has no files attached: nothing to extract")
    for name in attached:
        parts = name.split("/")  # of a bag in a folder
        if {"", ".", ".."} & {*parts} or any(c in "\\:" or not c.isprintable() for c in name):
            raise BagError(f"{bag} has a file attached that is called {name!r}: not a file's name")
    files = []
    for name, each in attached.items():
        files.append(folder / name)
        with new_file(files[-1]) as stream:
            stream.write(each.data)
    if damage:
        written = f"; the other {len(files)} are written" if files else ""
        raise BagError("; ".join(fault.text for fault in damage) + written)
    return files


def new_file(file: Path) -> BinaryIO:
    """Open a file for writing that was not there, in a folder that is made.

    Raises:
        BagError: it is there already, or cannot be written.
    """
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        return file.open("xb")
    except FileExistsError:
        raise BagError(f"{file} exists already: choose another folder with --out") from None
    except OSError as error:
        raise BagError(f"{file} cannot be written: {error.strerror}") from None


def versions() -> str:
    """Return the versions of Python, ROS 2 and the installed packages, one a line."""
    lines = [
        f"python {platform.python_version()}",
        f"system {platform.platform()}",
        f"ROS_DISTRO {os.environ.get('ROS_DISTRO') or 'none'}",
        f"RMW_IMPLEMENTATION {os.environ.get('RMW_IMPLEMENTATION') or 'default'}",
        f"byte order {sys.byteorder}",
        f"us_sim_code {code_checksum()}",
    ]
    read = (each.metadata for each in distributions())  # which is parsed at each access
    packages = {str(each["Name"]): str(each["Version"]) for each in read if each["Name"]}
    return "\n".join([*lines, *(f"{n} {v}" for n, v in sorted(packages.items()))]) + "\n"


def code_checksum() -> str:
    """Return the SHA-256 of this package's source files: its version changes less often."""
    root = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for file in sorted(root.rglob("*.py")):
        digest.update(f"{file.relative_to(root).as_posix()}\0".encode())
        digest.update(file.read_bytes())
    return digest.hexdigest()


@dataclass(frozen=True)
class Repaired:
    """Result of a repair."""

    path: Path  # the new file
    message_count: int
    faults: tuple[Fault, ...]  # of the bag; none if it was whole


def repair(path: str | Path, out: str | Path) -> Repaired:
    """Write all that can be read of a bag as a new one; the bag itself is not touched.

    Args:
        path: the bag, as `read_bag` takes it.
        out: where the new bag goes, as `BagWriter` takes it.

    Raises:
        BagError: there is no bag, nothing of it can be read, ``out`` is there already, or it
            cannot be written.
    """
    bag = read_bag(path)
    damage = [*bag.opening_faults]
    with BagWriter(out) as writer:
        for attached in bag.attachments.values():
            writer.attach(attached.name, attached.media_type, attached.data, attached.log_time)
        for note in bag.notes:
            if note.name != "rosbag2":  # which the writer makes anew
                writer.note(note.name, note.metadata)
        kept = []
        for topic in bag.topics:
            try:
                if topic.encoding != "cdr":
                    raise BagError(f"{topic.encoding} is not CDR")
                writer.add_topic(
                    topic.name,
                    topic.type_name,
                    topic.qos,
                    topic.type_hash or None,
                    schema=topic.schema,
                    defined=False,
                )
                kept.append(topic.name)
            except BagError as error:
                text = f"{topic.name} is left out: {error}"
                damage.append(Fault(text, topic.message_count))
        for message in bag.messages(kept, damage):
            times = message.log_time, message.publish_time
            writer.write(message.topic, message.data, *times, message.sequence)
    return Repaired(writer.path, writer.message_count, tuple(damage))
