"""The list of scenes and cases that can be loaded, each described for a person."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from us_sim.errors import UsSimError
from us_sim.scene.reading import find_installed_scenes, find_scene, load_scene
from us_sim.scene.scene import CASE_PREFIX, EXERCISE_PREFIX


@dataclass(frozen=True)
class ListedScene:
    """A scene or a case in a list."""

    name: str
    origin: str  # what loads it: a scene's file, or `case:` and the case's folder
    kind: str = "scene"  # or case, or exercise
    description: str = ""
    region: str = ""  # of the body
    structures: tuple[str, ...] = ()
    probe: str = ""
    tracker: str = ""  # where poses come from
    problem: str = ""  # why it cannot be loaded as it is


def list_scenes() -> Iterator[ListedScene]:
    """List exercises that name a scene, installed scenes, and cases; each name once."""
    from us_sim.scoring.exercise import read_installed_exercises
    from us_sim.volume.cases.case import find_cases, list_case_roots

    for exercise in read_installed_exercises():
        if exercise.scene is not None:
            origin, about = f"{EXERCISE_PREFIX}{exercise.origin}", exercise.description
            yield ListedScene(
                exercise.name, origin, "exercise", f"{about} {exercise.minutes} min", exercise.scene
            )
    for file in find_installed_scenes().values():
        yield describe_scene(str(file))
    folders: dict[str, Path] = {}
    for root in list_case_roots():
        if os.path.isdir(root):
            for folder in find_cases(root):
                folders.setdefault(folder.name, folder)
    for folder in folders.values():
        yield describe_scene(f"{CASE_PREFIX}{folder.resolve()}")


def describe_scene(name: str) -> ListedScene:
    """Describe a scene, or a case after ``case:``; a fault of it is its entry's ``problem``."""
    if name.startswith(CASE_PREFIX):
        return _describe_case(Path(name.removeprefix(CASE_PREFIX)))
    try:
        scene = load_scene(name)
    except UsSimError as error:
        origin = name
        with contextlib.suppress(UsSimError):
            origin = str(find_scene(name))
        return ListedScene(Path(name).stem, origin, problem=str(error).removeprefix(f"{origin}: "))
    return ListedScene(
        scene.name,
        scene.origin,
        description=scene.description,
        structures=tuple(scene.structures),
        probe=scene.probe.geometry,
        tracker=scene.tracker.source.name,
    )


def _describe_case(folder: Path) -> ListedScene:
    from us_sim.volume.cases.case import list_case, read_case

    origin, case = f"{CASE_PREFIX}{folder}", list_case(folder)
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
