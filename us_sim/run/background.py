"""A module that works in a process of its own, at low priority, and tells how far it is.

Bags that a person may want to play: those of the working folder, and installed ones.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path, PurePosixPath
from typing import Any

from us_sim.errors import BagError
from us_sim.recording.metadata import read_metadata
from us_sim.run.fork_server import end_with_parent
from us_sim.share import full_path, shared_roots

_NICE = 10


class Background:
    """Runs a module, which says a JSON mapping a line.

    Args:
        module: its name.
        arguments: that it gets.
        nice: by how much its priority is lower than this process's.
    """

    def __init__(self, module: str, *arguments: str, nice: int = _NICE) -> None:
        package = str(Path(__file__).resolve().parents[2])
        search = os.pathsep.join(filter(None, [package, os.environ.get("PYTHONPATH", "")]))
        self._said: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", module, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            errors="replace",
            env=os.environ | {"PYTHONPATH": search},
            start_new_session=True,
            preexec_fn=end_with_parent if sys.platform == "linux" else None,
        )
        with contextlib.suppress(AttributeError, OSError):
            os.setpriority(os.PRIO_PROCESS, self._process.pid, os.getpriority(0, 0) + nice)
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def said(self) -> list[dict[str, Any]]:
        """What it has said since this was asked last."""
        told = []
        with contextlib.suppress(queue.Empty):
            while True:
                told.append(self._said.get_nowait())
        return told

    @property
    def has_ended(self) -> bool:
        """Whether it is over, and all that it said has come."""
        return not self._reader.is_alive() and self._process.poll() is not None

    def end(self) -> None:
        """End it, whatever it does."""
        self._process.kill()
        self._process.wait()
        self._reader.join()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            with contextlib.suppress(ValueError):
                said = json.loads(line)
                if isinstance(said, dict):
                    self._said.put(said)
        self._process.wait()


def tell(**said: Any) -> None:
    """Say something to the process that started this one."""
    print(json.dumps(said), flush=True)


_SUFFIXES = (".mcap", ".db3", ".mcap.zstd")
_MOST_BAGS = 500
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
    return [file for _, file in sorted(found, reverse=True)[:_MOST_BAGS]]


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


@functools.lru_cache(_MOST_BAGS)
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
