"""Lists what can be loaded, and makes its thumbnails, for the process that started this program.

As a program: ``python -m us_sim.run.catalogue [SCENE ...]`` lists those, then what is installed.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence

from us_sim.errors import UsSimError
from us_sim.run.background import tell
from us_sim.scene.listing import ListedScene, listed_scene, listed_scenes, thumbnail_file
from us_sim.scene.reading import load_scene


def main(names: Sequence[str]) -> int:
    """Tell all scenes, then the file of each one's thumbnail as soon as there is one."""
    scenes: dict[str, ListedScene] = {}
    for scene in (*map(listed_scene, names), *listed_scenes()):
        scenes.setdefault(scene.origin, scene)
    tell(scenes=[dataclasses.asdict(scene) for scene in scenes.values()])
    for scene in scenes.values():
        if scene.problem:
            continue
        try:
            file = thumbnail_file(load_scene(scene.origin))
        except (UsSimError, OSError, MemoryError):
            continue  # a list without a picture will do
        tell(thumbnail=scene.origin, file=str(file))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
