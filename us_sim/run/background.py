"""Work beside a running simulation: making a scene, and listing scenes and bags to load.

As a program it tells the process that started it how far it is, a JSON mapping a line:
``python -m us_sim.run.background NICE make SCENE [VOLUME]`` makes the volume and the tissue of a
scene, which are kept; ``… list [SCENE …]`` lists those scenes and the installed ones, with
thumbnails. NICE is by how much its priority is lower.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from us_sim.errors import UsSimError
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
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-m", "us_sim.run.background", str(nice), *arguments],
            stdin=LIFELINE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=child_environment(),
            start_new_session=True,
        )
        assert self.process.stdout is not None
        self._output = self.process.stdout
        os.set_blocking(self._output.fileno(), False)
        self._begun = b""  # a line that is not complete

    def said(self) -> list[dict[str, Any]]:
        """Return its messages since this was called last."""
        *lines, self._begun = (self._begun + (self._output.read() or b"")).split(b"\n")
        return [json.loads(line) for line in lines]

    @property
    def has_ended(self) -> bool:
        """Whether it says nothing more than `said` returns now."""
        return self.process.poll() is not None

    def end(self) -> None:
        """End it, whatever it does."""
        self.process.kill()
        self.process.wait()
        self._output.close()


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
        if time.monotonic() - told > 0.1:
            told = time.monotonic()
            _tell(fraction=fraction, text=text)

    return show


def list_scenes(*names: str) -> None:
    """Tell all scenes, then the file of each one's thumbnail as soon as there is one."""
    scenes: dict[str, ListedScene] = {}
    for scene in (*map(listed_scene, names), *listed_scenes()):
        scenes.setdefault(scene.origin, scene)
    _tell(scenes=[dataclasses.asdict(scene) for scene in scenes.values()])
    for scene in scenes.values():
        with contextlib.suppress(UsSimError, OSError, MemoryError):  # a list will do without
            _tell(thumbnail=scene.origin, file=str(thumbnail_file(load_scene(scene.origin))))


def bags_in_reach(recordings: str | None = None) -> dict[str, str]:
    """Return bags of the working folder and installed ones: files by names, the newest first.

    A bag of several files is one with its folder; each of these files is a bag of its own, too.

    Args:
        recordings: folder to which pages record, wherever that is.
    """
    here = Path.cwd()
    places = [(here, here), (here / "bags", here)]
    if recordings:
        places.insert(1, (full_path(recordings), full_path(recordings).parent))
    places += [(root / "bags", root / "bags") for root in shared_roots()]
    bags: dict[str, str] = {}
    for folder, base in places:
        found = [each for each in folder.glob("*") if each.suffix in (".mcap", ".db3", ".zstd")]
        found += [each.parent for each in folder.glob("*/metadata.yaml")]
        for file in sorted(found, key=_changed_at, reverse=True)[:_MOST_BAGS]:
            if str(file) not in bags.values():
                bags.setdefault(file.relative_to(base).as_posix(), str(file))
    return bags


def _changed_at(file: Path) -> float:
    try:
        return file.stat().st_mtime
    except OSError:  # taken away meanwhile
        return 0.0


if __name__ == "__main__":
    nice, job, *arguments = sys.argv[1:]
    with contextlib.suppress(AttributeError):  # Windows
        os.nice(int(nice))
    (make_scene if job == "make" else list_scenes)(*arguments)
