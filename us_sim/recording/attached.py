"""Files attached to a recording: what it was made with, and writing them out again."""

from __future__ import annotations

import os
import platform
import sys
from importlib.metadata import distributions
from pathlib import Path

from us_sim.errors import BagError
from us_sim.recording.reader import read_bag
from us_sim.recording.topic import Fault


def extract(bag: Path, folder: Path) -> list[Path]:
    """Write the files that are attached to a bag; their paths.

    Raises:
        BagError: it has none, a name is no file's, a file is there already, or cannot be written;
            or one is damaged, and all others are written.
    """
    damage: list[Fault] = []
    attached = read_bag(bag).attachments(damage)
    if not attached and not damage:
        raise BagError(f"{bag} has no files attached: nothing to extract")
    for name in attached:
        parts = name.split("/")  # of a bag in a folder
        if {"", ".", ".."} & {*parts} or any(c in "\\:" or not c.isprintable() for c in name):
            raise BagError(f"{bag} has a file attached that is called {name!r}: not a file's name")
    files = []
    for name, each in attached.items():
        file = folder / name
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            with file.open("xb") as stream:
                stream.write(each.data)
        except FileExistsError:
            raise BagError(f"{file} exists already: choose another folder with --out") from None
        except OSError as error:
            raise BagError(f"{file} cannot be written: {error.strerror}") from None
        files.append(file)
    if damage:
        written = f"; the other {len(files)} are written" if files else ""
        raise BagError("; ".join(fault.text for fault in damage) + written)
    return files


def versions() -> str:
    """What this process runs on: Python, ROS 2 and the installed packages, one a line."""
    lines = [
        f"python {platform.python_version()}",
        f"system {platform.platform()}",
        f"ROS_DISTRO {os.environ.get('ROS_DISTRO') or 'none'}",
        f"RMW_IMPLEMENTATION {os.environ.get('RMW_IMPLEMENTATION') or 'default'}",
        f"byte order {sys.byteorder}",
    ]
    packages = {
        str(each.metadata["Name"]): str(each.version)
        for each in distributions()
        if each.metadata["Name"]
    }
    return "\n".join([*lines, *(f"{n} {v}" for n, v in sorted(packages.items()))]) + "\n"
