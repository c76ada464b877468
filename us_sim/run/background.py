"""Work beside a running simulation: making a scene, and listing scenes and bags to load.

As a program it tells the process that started it how far it is, a JSON mapping a line:
``python -m us_sim.run.background make SCENE [VOLUME]`` makes the volume and the tissue of a scene,
which are kept; ``… list [SCENE …]`` lists those scenes and the installed ones, with thumbnails.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from pathlib import Path, PurePosixPath
from typing import Any

from us_sim.errors import BagError, UsSimError
from us_sim.recording.metadata import read_metadata
from us_sim.run.processes import LIFELINE, child_environment
from us_sim.scene.building import volume_of
from us_sim.scene.listing import ListedScene, listed_scene, listed_scenes, thumbnail_file
from us_sim.scene.reading import load_scene
from us_sim.share import full_path, shared_roots

_MOST_BAGS = 500  # of a folder, the newest


class Background:
    """This module as a program, at low priority.

    Args:
        arguments: of its command line.
        nice: by how much its priority is lower than this process's.
    """

    def __init__(self, *arguments: str, nice: int) -> None:
        self._said: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "us_sim.run.background", *arguments],
            stdin=LIFELINE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            errors="replace",
            env=child_environment(),
            start_new_session=True,
        )
        with contextlib.suppress(AttributeError, OSError):
            os.setpriority(os.PRIO_PROCESS, self._process.pid, os.getpriority(0, 0) + nice)
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def said(self) -> list[dict[str, Any]]:
        """Its messages since this was called last."""
        told = []
        with contextlib.suppress(queue.Empty):
            while True:
                told.append(self._said.get_nowait())
        return told

    @property
    def has_ended(self) -> bool:
        """Whether it is over, and all its messages have come."""
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


def _tell(**said: Any) -> None:
    print(json.dumps(said), flush=True)


def make_scene(name: str, volume: str = "") -> None:
    """Make the volume and the tissue; a phantom and a case's tissue are kept."""
    from us_sim.scene.case_tissue import keep_tissue  # needs numba, which supervision does not

    try:
        scene = load_scene(name, volume=volume or None)
        text = f"making {scene.volume.name}" if scene.volume.phantom else "reading the volume"
        _tell(fraction=0.0, text=text)
        read = volume_of(scene, _telling(text))
        keep_tissue(scene, read)
    except UsSimError as error:
        _tell(refused=str(error))
    except MemoryError:
        _tell(refused=f"{name}: there is not enough memory")
    else:
        _tell(ready=True)


def _telling(text: str) -> Callable[[float, str], None]:
    told = 0.0

    def show(fraction: float, _: str) -> None:
        nonlocal told
        now = time.monotonic()
        if now - told > 0.1:
            told = now
            _tell(fraction=fraction, text=text)

    return show


def list_scenes(*names: str) -> None:
    """Tell all scenes, then the file of each one's thumbnail as soon as there is one."""
    scenes: dict[str, ListedScene] = {}
    for scene in (*map(listed_scene, names), *listed_scenes()):
        scenes.setdefault(scene.origin, scene)
    _tell(scenes=[dataclasses.asdict(scene) for scene in scenes.values()])
    for scene in scenes.values():
        if not scene.problem:
            with contextlib.suppress(UsSimError, OSError, MemoryError):  # a list will do without
                file = thumbnail_file(load_scene(scene.origin))
                _tell(thumbnail=scene.origin, file=str(file))


def bags_in_reach(recordings: str | None = None) -> dict[str, str]:
    """Bags of the working folder and installed ones: files by names, the newest first.

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


def _is_bag(file: Path) -> bool:
    return file.name.endswith((".mcap", ".db3", ".mcap.zstd"))


def _bags_in(folder: Path) -> Iterator[Path]:
    for path in _entries(folder):
        yield from [path] if _is_bag(path) else _bags_at(path)


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
        if _is_bag(file) and file.name not in named:
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


if __name__ == "__main__":
    job, *arguments = sys.argv[1:]
    (make_scene if job == "make" else list_scenes)(*arguments)
