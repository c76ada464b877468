"""The files that are attached to a recording, written again; and the versions among them."""

from __future__ import annotations

import hashlib
import os
import platform
import sys
from importlib.metadata import distributions
from pathlib import Path
from typing import BinaryIO

from us_sim.errors import BagError
from us_sim.recording.reader import read_bag


def extract_files(bag: Path, folder: Path) -> list[Path]:
    """Write the files that are attached to a bag; return their paths.

    Raises:
        BagError: it has none, a name is no file's, or a file is there already or cannot be
            written.
    """
    attached = read_bag(bag).attachments
    if not attached:
        raise BagError(f"{bag} has no files attached: nothing to extract")
    for name in attached:
        parts = name.split("/")  # of a bag in a folder
        if {"", ".", ".."} & {*parts} or any(c in "\\:" or not c.isprintable() for c in name):
            raise BagError(f"{bag} has a file attached that is called {name!r}: not a file's name")
    for name, each in attached.items():
        with new_file(folder / name) as stream:
            stream.write(each.data)
    return [folder / name for name in attached]


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


def list_versions() -> str:
    """Return the versions of Python, ROS 2 and the installed packages, one a line."""
    lines = [
        f"python {platform.python_version()}",
        f"system {platform.platform()}",
        f"ROS_DISTRO {os.environ.get('ROS_DISTRO') or 'none'}",
        f"RMW_IMPLEMENTATION {os.environ.get('RMW_IMPLEMENTATION') or 'default'}",
        f"byte order {sys.byteorder}",
        f"us_sim_code {compute_code_checksum()}",
    ]
    read = (each.metadata for each in distributions())  # which is parsed at each access
    packages = {str(each["Name"]): str(each["Version"]) for each in read if each["Name"]}
    return "\n".join([*lines, *(f"{n} {v}" for n, v in sorted(packages.items()))]) + "\n"


def compute_code_checksum() -> str:
    """Return the SHA-256 of this package's source files: its version changes less often."""
    root = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for file in sorted(root.rglob("*.py")):
        digest.update(f"{file.relative_to(root).as_posix()}\0".encode())
        digest.update(file.read_bytes())
    return digest.hexdigest()
