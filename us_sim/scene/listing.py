"""Scenes and cases that can be loaded, each described for a person, and a thumbnail."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from us_sim.cache import cache_folder
from us_sim.errors import UsSimError
from us_sim.geometry.pose import Pose
from us_sim.scene.building import scanner_of, volume_of
from us_sim.scene.reading import find_scene, load_scene
from us_sim.scene.scene import CASE_PREFIX, Scene
from us_sim.share import shared_roots


@dataclass(frozen=True)
class ListedScene:
    """A scene or a case in a list."""

    name: str
    origin: str  # what loads it: a scene's file, or `case:` and the case's folder
    kind: str = "scene"  # or case
    description: str = ""
    region: str = ""  # of the body
    structures: tuple[str, ...] = ()
    probe: str = ""
    tracker: str = ""  # where poses come from
    problem: str = ""  # why it cannot be loaded as it is

    @classmethod
    def from_json(cls, said: Mapping[str, Any]) -> ListedScene:
        """From a mapping that `dataclasses.asdict` and JSON have made of one."""
        return cls(**{**said, "structures": tuple(said["structures"])})


def listed_scenes() -> Iterator[ListedScene]:
    """Installed scenes, then the cases of `case_roots`; each name once."""
    from us_sim.volume.cases.case import case_roots, cases_in

    files: dict[str, Path] = {}
    for root in shared_roots():
        for file in sorted((root / "config" / "scenes").glob("*.yaml")):
            files.setdefault(file.stem, file)
    for file in files.values():
        yield listed_scene(str(file))
    folders: dict[str, Path] = {}
    for root in case_roots():
        if os.path.isdir(root):
            for folder in cases_in(root):
                folders.setdefault(folder.name, folder)
    for folder in folders.values():
        yield listed_scene(f"{CASE_PREFIX}{folder.resolve()}")


def listed_scene(name: str) -> ListedScene:
    """The entry of a scene, or of ``case:`` and a case."""
    if name.startswith(CASE_PREFIX):
        return _listed_case(Path(name.removeprefix(CASE_PREFIX)))
    try:
        scene = load_scene(name)
    except UsSimError as error:
        origin = _origin(name)
        return ListedScene(Path(name).stem, origin, problem=str(error).removeprefix(f"{origin}: "))
    return ListedScene(
        scene.name,
        scene.origin,
        description=scene.description,
        structures=tuple(scene.structures),
        probe=scene.probe.geometry,
        tracker=scene.tracker.source.name,
    )


def _origin(name: str) -> str:
    try:
        return str(find_scene(name))
    except UsSimError:
        return name


def _listed_case(folder: Path) -> ListedScene:
    from us_sim.volume.cases.case import listed, read_case

    origin, case = f"{CASE_PREFIX}{folder}", listed(folder)
    if case.problem:
        return ListedScene(case.name, origin, "case", problem=case.problem)
    settings = read_case(folder).settings
    return ListedScene(
        case.name,
        origin,
        "case",
        settings.description,
        case.region,
        tuple(settings.structures),
        case.probe,
    )


WIDTH, HEIGHT = 240, 180
"""Pixels."""
_QUALITY = 85
_FORM = 1
"""Raised when another picture is made of the same scene."""


def thumbnail_file(scene: Scene) -> Path:
    """The JPEG file in the cache folder, made if it is not there.

    Raises:
        UsSimError: what the scene names cannot be read.
        OSError: the file cannot be written.
    """
    folder = cache_folder() / "thumbnails"
    file = folder / f"{_key(scene)}.jpg"
    if not file.exists():
        folder.mkdir(parents=True, exist_ok=True)
        data = _jpeg(scene)
        with tempfile.NamedTemporaryFile(dir=folder, delete=False) as partial:
            partial.write(data)
        Path(partial.name).rename(file)
    return file


def _key(scene: Scene) -> str:
    """A name for all that the thumbnail depends on: volume, probe and grey values."""
    source = scene.volume.case or scene.volume.file
    changed = 0
    if source:
        path = Path(source)
        files = sorted(path.glob("*.nrrd")) if scene.volume.case else [path]
        changed = max((file.stat().st_mtime_ns for file in files if file.is_file()), default=0)
    about = [_FORM, repr(scene.volume), changed, repr(scene.probe), repr(scene.imaging)]
    return hashlib.sha256(json.dumps(about).encode()).hexdigest()[:24]


def _jpeg(scene: Scene) -> bytes:
    """The image at rest, with all of the probe's face on the skin, in its true shape on black."""
    import cv2  # no process of a simulation that only reads the list loads it

    scene = dataclasses.replace(scene, imaging=dataclasses.replace(scene.imaging, contact=False))
    scanner = scanner_of(scene, volume_of(scene))
    sides = np.array([scanner.probe.width, scanner.probe.height])
    columns, rows = np.maximum(np.rint(sides * (np.array([WIDTH, HEIGHT]) / sides).min()), 1)
    fitted = cv2.resize(
        scanner.image(Pose()), (int(columns), int(rows)), interpolation=cv2.INTER_AREA
    )
    picture = np.zeros((HEIGHT, WIDTH), np.uint8)
    top, left = (HEIGHT - fitted.shape[0]) // 2, (WIDTH - fitted.shape[1]) // 2
    picture[top : top + fitted.shape[0], left : left + fitted.shape[1]] = fitted
    _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return bytes(data)
