"""Bags that a person may want to play: those of the working folder, and installed ones."""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path, PurePosixPath

from us_sim.errors import BagError
from us_sim.recording.metadata import read_metadata
from us_sim.share import full_path, shared_roots

_SUFFIXES = (".mcap", ".db3", ".mcap.zstd")
_MOST = 500
"""Bags of a folder that are listed, the newest."""


def bags_in_reach(recordings: str | None = None) -> dict[str, str]:
    """Files by the names that a person reads; the newest of the working folder come first.

    Files in a bag's folder that do not belong to that bag are bags of their own.

    Args:
        recordings: folder to which pages record, wherever that is.
    """
    bags: dict[str, str] = {}
    here = Path.cwd()
    folders = {here: "", here / "bags": "bags/"}
    for root in shared_roots():
        folders.setdefault(root / "bags", "")
    found = [(_newest_first(_bags_in(folder)), folder, name) for folder, name in folders.items()]
    if recordings and (folder := full_path(recordings)) not in folders:
        found.insert(1, (_newest_first(_bags_at(folder)), folder.parent, ""))
    for files, folder, before in found:
        for file in files:
            bags.setdefault(f"{before}{file.relative_to(folder).as_posix()}", str(file))
    return bags


def _newest_first(files: Iterable[Path]) -> list[Path]:
    found = []
    for file in files:
        with contextlib.suppress(OSError):  # taken away meanwhile
            found.append((file.stat().st_mtime, file))
    return [file for _, file in sorted(found, reverse=True)[:_MOST]]


def _bags_in(folder: Path) -> Iterator[Path]:
    for path in _entries(folder):
        yield from [path] if path.name.endswith(_SUFFIXES) else _bags_at(path)


def _bags_at(folder: Path) -> Iterator[Path]:
    """A bag's folder, and the files in it that its metadata does not name."""
    metadata = folder / "metadata.yaml"
    if not os.path.isfile(metadata):
        return
    yield folder
    named: Collection[str] = ()
    with contextlib.suppress(OSError):
        named = _named_in(metadata, metadata.stat().st_mtime_ns)
    for file in _entries(folder):
        if file.name.endswith(_SUFFIXES) and file.name not in named:
            yield file


@functools.lru_cache(_MOST)
def _named_in(metadata: Path, _changed: int) -> Collection[str]:
    """Names of a bag's files; none where its metadata cannot be read."""
    try:
        return {PurePosixPath(file.path).name for file in read_metadata(metadata).files}
    except BagError:
        return ()


def _entries(folder: Path) -> list[Path]:
    try:
        return list(folder.iterdir())
    except OSError:
        return []
