"""Reading scene files: YAML, merged with the scene it is based on, every key and value checked.

>>> from us_sim.scene.reading import check_files, merge_documents, parse_scene
>>> merge_documents({"probe": {"depth": "4 cm", "lines": 128}, "skin": {}},
...        {"probe": {"depth": "6 cm"}, "skin": None})
{'probe': {'depth': '6 cm', 'lines': 128}}
>>> scene = parse_scene({"name": "bare", "volume": {"phantom": "upper_arm"},
...                      "probe": {"aperture": "40 mm", "depth": "40 mm"}})
>>> [part.node for part in scene.list_parts() if part.needed]
['probe_tracker', 'slice_interpolator']
>>> check_files(scene)
[]
"""

from __future__ import annotations

import os
import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin

from us_sim.errors import CaseError, ProbeError, SceneError, UsSimError
from us_sim.scene.building import (
    build_probe,
    build_tracking,
    load_camera_body,
    load_path,
    require_labels,
    require_materials,
    source_settings,
)
from us_sim.scene.scene import CASE_PREFIX, EXERCISE_PREFIX, Scene, TissueSettings
from us_sim.settings.choice import Choice
from us_sim.settings.reading import SettingsReader
from us_sim.settings.setting import Settings, kinds_of, rules_of
from us_sim.settings.spelling import find_closest
from us_sim.settings.text_files import read_yaml
from us_sim.share import full_path, shared_roots
from us_sim.volume.settings import VOXEL_SIZE

BASE = "based_on"
"""The key that names another scene; what a scene says goes before what its base says."""


def read_document(
    path: Path, find: Callable[[str | Path], Path], seen: tuple[Path, ...] = ()
) -> tuple[Any, list[Path]]:
    """Read a scene file and its bases; return the document, and the folders of relative files.

    Args:
        path: of the file.
        find: returns the file of the scene of a name.
        seen: files that are based on this one.

    Raises:
        SceneError: it cannot be read, is not YAML, or is based on itself.
    """
    document: Any = read_yaml(path, SceneError)
    folders = [path.parent]
    if not isinstance(document, dict) or BASE not in document:
        return document, folders
    name = document.pop(BASE)
    if not isinstance(name, str) or not name:
        raise SceneError(f"{path}: {BASE}: must be a scene's file or name, not {name!r}")
    beside = path.parent / name
    try:
        base = beside.resolve() if os.path.isfile(beside) else find(name)
    except SceneError as error:
        raise SceneError(f"{path}: {BASE}: {error}") from error
    if base in (*seen, path):
        raise SceneError(f"{path}: {BASE}: {base} is based on this scene itself")
    below: Any
    below, more = read_document(base, find, (*seen, path))
    if not isinstance(below, dict):
        raise SceneError(f"{path}: {BASE}: {base} is no mapping of keys")
    return merge_documents(below, document), [*folders, *more]


def merge_documents(below: dict[Any, Any], above: dict[Any, Any]) -> dict[Any, Any]:
    """Override ``below`` by ``above``: mappings key by key, anything else replaced.

    If ``above`` chooses another kind of probe, collider, filter, ..., the keys below that not all
    kinds have go; if it names a file in place of a box, the box goes. ``null`` takes back what
    ``below`` says.
    """
    return _merge(below, above, Scene)


def _merge(
    below: dict[Any, Any],
    above: dict[Any, Any],
    settings: type[Settings] | None,
    choice: Choice | None = None,
    each: Any = None,
) -> dict[Any, Any]:
    """Merge mappings whose keys are those of ``settings`` or of ``choice``.

    Keys may also be names that a person chose; then ``each`` is the type of every value.
    """
    gone = _dropped_keys(below, above, choice) if choice else set()
    rules = rules_of(settings) if settings else {}
    gone |= _replaced_keys(above, settings.alternatives) if settings else set()
    gone |= {key for key, value in above.items() if value is None}
    for rule in rules.values():
        if rule.choice and rule.place == "beside":
            gone |= _dropped_keys(below, above, rule.choice)
        elif (
            rule.choice and rule.place == "named" and _is_choice_changed(below, above, rule.choice)
        ):
            gone |= set(rule.choice.names)
        elif rule.applies and above.get(rule.applies[0]) not in (None, *rule.applies[1]):
            gone |= {name for name, other in rules.items() if other is rule}
    result = {key: value for key, value in below.items() if key not in gone}
    for key, value in above.items():
        under = result.get(key)
        if isinstance(under, dict) and isinstance(value, dict):
            kind = kinds_of(settings).get(key) if settings else each
            rule_of_key = rules.get(key)
            chosen = rule_of_key.choice if rule_of_key and rule_of_key.place == "within" else None
            value = _merge(under, value, _settings_in(kind), chosen, _kind_of_each(kind))
        if value is not None or key not in below:
            result[key] = value
    return result


def _replaced_keys(above: dict[Any, Any], alternatives: Mapping[str, tuple[str, ...]]) -> set[str]:
    """Return the keys that go since ``above`` names the alternative to them."""
    named = [name for name in alternatives if above.get(name) is not None]
    if len(named) != 1:
        return set()
    others = {key for name, own in alternatives.items() for key in (name, *own)}
    return others - {named[0], *alternatives[named[0]]}


def _is_choice_changed(below: dict[Any, Any], above: dict[Any, Any], choice: Choice) -> bool:
    return choice.key in above and above[choice.key] != below.get(choice.key)


def _dropped_keys(below: dict[Any, Any], above: dict[Any, Any], choice: Choice) -> set[str]:
    """Return the keys that not all options have, if ``above`` chooses another option."""
    if not _is_choice_changed(below, above, choice):
        return set()
    keys = [set(rules_of(choice.load_settings(name))) for name in choice.names]
    return set().union(*keys) - keys[0].intersection(*keys)


def _settings_in(kind: Any) -> type[Settings] | None:
    options = get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
    for option in options:
        if isinstance(option, type) and issubclass(option, Settings):
            return option
    return None


def _kind_of_each(kind: Any) -> Any:
    return get_args(kind)[1] if get_origin(kind) in (dict, Mapping) else None


def check_files(scene: Scene) -> list[str]:
    """Read the files that the scene names, of its volume only the header; return their keys.

    Raises:
        UsSimError: one cannot be used, and why.
    """
    checked = []
    if scene.volume.file:
        from us_sim.volume.files.readers import read_placement

        read_placement(Path(scene.volume.file))
        checked.append("volume.file (its header)")
    if scene.volume.case:
        from us_sim.volume.cases.case import read_case

        case = read_case(scene.volume.case)
        case.read_placement()
        if case.has_labels:
            case.check_grids()
        checked.append("volume.case (its headers)")
    check_structure_names(scene)
    if scene.tissue is not None and scene.tissue.mesh.file:
        checked.append(f"tissue.mesh.file ({'; '.join(_mesh_remarks(scene.tissue))})")
    surfaces = {f"structures.{name}.file": s.file for name, s in scene.structures.items()}
    if scene.skin is not None:
        surfaces["skin.file"] = scene.skin.file
    for key, file in surfaces.items():
        if file:
            from us_sim.skin.surface import read_surface

            read_surface(file)
            checked.append(key)
    checked += _check_tracker_files(scene)
    checked += ["exercise"] if scene.exercise else []
    if scene.path:
        from us_sim.recording.path import read_path

        read_path(Path(scene.path), option="--topic")
        checked.append("path")
    return checked


def _check_tracker_files(scene: Scene) -> list[str]:
    """Read the files that the scene's tracker names; return their keys."""
    tracker = scene.tracker
    build_tracking(scene)
    poses = ("registration", "calibration")
    checked = [f"tracker.{key}" for key in poses if isinstance(getattr(tracker, key), str)]
    if tracker.source.name == "camera" and source_settings(scene, "camera").body:
        load_camera_body(scene)
        checked.append("tracker.camera.body")
    if tracker.source.name == "path" and tracker.file:
        load_path(scene, Path(tracker.file))
        checked.append("tracker.file")
    return checked


def check_structure_names(scene: Scene) -> None:
    """Refuse names of the scene and its exercise that the volume lacks, without reading it."""
    names = _label_names(scene)
    require_labels(scene, names or {})
    if scene.tissue is not None:
        require_materials(scene, scene.tissue.materials, names)
    if scene.exercise:
        from us_sim.scoring.exercise import read_exercise
        from us_sim.scoring.lumen import find_lumen_labels

        vessels = find_lumen_labels(names or {})
        for name in read_exercise(scene.exercise).assigned.structures:
            if name not in vessels:
                raise SceneError(
                    f"{scene.origin}: exercise: {scene.exercise} is with {name}, which is no "
                    f"vessel of the volume; it has {', '.join(vessels) or 'none'}"
                )


def _label_names(scene: Scene) -> Mapping[int, str] | None:
    """Read the labels' names, by numbers, without the volume; None if it has no labels."""
    if scene.volume.case:
        from us_sim.volume.cases.case import read_case

        case = read_case(scene.volume.case)
        return case.settings.label_names if case.has_labels else None
    if scene.volume.phantom:
        from us_sim.volume.phantom.phantom import load_or_make_phantom

        coarsest = load_or_make_phantom(scene.volume.phantom, scene.volume.seed, VOXEL_SIZE.maximum)
        return coarsest.label_names
    return None


def _mesh_remarks(tissue: TissueSettings) -> list[str]:
    """List the remarks about a mesh's file that need no volume."""
    from us_sim.tissue.mesh.file import read_mesh
    from us_sim.tissue.model import FACES, describe_held_nodes, face_nodes

    given = tissue.mesh
    mesh, remarks = read_mesh(Path(given.file or ""), given.unit, given.pose.pose)
    names = [name for name in tissue.fixed if name in FACES]
    held = [describe_held_nodes(name, face_nodes(mesh, name, given.margin), mesh) for name in names]
    return [f"{len(mesh.nodes)} nodes", *remarks, *(said for said in held if said)]


def find_installed_scenes() -> dict[str, Path]:
    """Find the files in ``config/scenes``, by name."""
    known: dict[str, Path] = {}
    for root in shared_roots():
        for file in sorted((root / "config" / "scenes").glob("*.yaml")):
            known.setdefault(file.stem, file)
    return known


def find_scene(name: str | Path) -> Path:
    """Find the scene file of a path, or of a name in ``config/scenes``.

    Raises:
        SceneError: there is no such file; the sentence lists the installed scenes.
    """
    path = Path(os.path.expanduser(name))
    if os.path.isfile(path):
        return path.resolve()
    known = find_installed_scenes()
    stem = path.name.removesuffix(".yaml")
    if str(path) in (stem, f"{stem}.yaml") and stem in known:
        return known[stem]
    from us_sim.scoring.exercise import find_exercise_files

    is_exercise = stem in find_exercise_files()
    like = f"{EXERCISE_PREFIX}{stem}" if is_exercise else find_closest(stem, known)
    hint = f"; did you mean {like}?" if like else ""
    raise SceneError(
        f"there is no scene file {name}; installed scenes are {', '.join(known)}{hint}"
    )


def load_scene(name: str | Path, *, volume: str | Path | None = None) -> Scene:
    """Read and validate a scene file, or make a scene of a case or for an exercise.

    Args:
        name: of the scene, or its file; or ``case:`` with the name or the folder of a case, or
            ``exercise:`` with the name or the file of an exercise.
        volume: a file in place of the scene's.

    Raises:
        SceneError: the file or a value in it cannot be used; one sentence with file and key.

    Examples:
        >>> scene = load_scene("upper_arm")
        >>> scene.tissue.solver, scene.case
        ('fem_nonlinear', None)
    """
    document, folders, origin = read_scene_document(name)
    if volume and isinstance(document, dict):
        document = with_volume(document, str(full_path(volume)))
    is_drawn = "#" in origin and "#" not in str(name)
    return replace(parse_scene(document, origin=origin, folders=folders), is_drawn=is_drawn)


def read_scene_document(name: str | Path) -> tuple[Any, list[Path], str]:
    """Read the document of a scene, case or exercise; also the folders of its files, and origin."""
    if str(name).startswith(CASE_PREFIX):
        case = str(name).removeprefix(CASE_PREFIX)
        try:
            folder = _find_case(case)
        except CaseError as error:
            raise SceneError(str(error)) from error
        return {"case": str(folder)}, [folder.parent], f"{CASE_PREFIX}{folder}"
    if str(name).startswith(EXERCISE_PREFIX):
        return _read_exercise_document(str(name).removeprefix(EXERCISE_PREFIX))
    path = find_scene(name)
    document, folders = read_document(path, find_scene)
    return document, folders, str(path)


def _read_exercise_document(name: str) -> tuple[Any, list[Path], str]:
    """Read the document of an exercise's scene, its folders, and its origin with the seed.

    The seed stands behind a ``#`` in the name, or is drawn.
    """
    from us_sim.scoring.exercise import read_exercise

    file, _, given = name.partition("#")
    try:
        exercise = read_exercise(file)
    except UsSimError as error:
        raise SceneError(str(error)) from error
    origin = f"{EXERCISE_PREFIX}{exercise.origin}"
    if exercise.scene is None:
        raise SceneError(f"{origin}: scene: is missing; name the one that it is done in")
    document, folders = read_document(find_scene(exercise.scene), find_scene)
    more: dict[Any, Any] = {"name": Path(exercise.origin).stem, "exercise": exercise.origin}
    more["description"] = exercise.description or exercise.name
    if given and (exercise.seeds is None or not given.isdecimal()):
        raise SceneError(f"{origin}#{given}: a seed is a number, of an exercise that has `seeds`")
    if exercise.seeds is not None:
        seed = int(given) if given else random.randint(*exercise.seeds)
        more["volume"] = {"seed": seed}
        origin += f"#{seed}"
    return merge_documents(document, more), folders, origin


def with_volume(document: dict[Any, Any], file: str) -> dict[Any, Any]:
    """Return the document with another volume in place of its own."""
    return merge_documents(document, {"volume": {"file": file}})


def with_path(document: dict[Any, Any], file: str) -> dict[Any, Any]:
    """Return the document with another path in place of its own and of its tracker's file."""
    tracker = document.get("tracker") or {}
    plays = {"tracker": {"file": file}} if tracker.get("source") == "path" else {}
    return merge_documents(document, {"path": file, **plays})


def parse_scene(document: object, *, origin: str = "scene", folders: Sequence[Path] = ()) -> Scene:
    """Validate a document as `load_scene` does; relative files are looked up in ``folders``."""
    if document is None:
        raise SceneError(f"{origin}: is empty; a scene has at least name, volume and probe")

    def find_file(name: str, key: str) -> str:
        return _find_existing(name, origin, [*folders, Path.cwd()], key)

    document = _with_case(document, origin, [*folders, Path.cwd()])
    document = _with_named_structures(document)
    # Files matter once all else is right.
    SettingsReader(origin, None, SceneError).read(Scene, document)
    read: Scene = SettingsReader(origin, find_file, SceneError).read(Scene, document)
    scene = replace(read, origin=origin)
    probe = build_probe(scene)
    if scene.imaging.acoustics.is_live:
        try:
            scene.imaging.acoustics.choose_frequency(probe.frequencies)
        except ProbeError as error:
            raise SceneError(f"{origin}: {error}") from error
    return scene


def _with_case(document: object, origin: str, folders: Sequence[Path]) -> object:
    """Complete a document that names a case by what the case says."""
    case = document.get("case") if isinstance(document, dict) else None
    if not isinstance(document, dict) or not isinstance(case, str) or not case.strip():
        return document
    from us_sim.scene.case_tissue import make_case_document

    try:
        return merge_documents(make_case_document(_find_case(case, folders)), document)
    except UsSimError as error:
        raise SceneError(f"{origin}: case: {error}") from error


def _with_named_structures(document: object) -> object:
    """Turn a list of structures' names, and names without a value, into empty mappings."""
    if not isinstance(document, dict) or "structures" not in document:
        return document
    given = document["structures"]
    if isinstance(given, list) and all(isinstance(name, str) for name in given):
        given = dict.fromkeys(given)
    if isinstance(given, dict):
        given = {name: {} if value is None else value for name, value in given.items()}
    return document | {"structures": given}


def _find_case(name: str, folders: Sequence[Path] = ()) -> Path:
    """Find a case's folder; the import is made late since it brings kinds of tissue along."""
    from us_sim.volume.cases.case import find_case

    return find_case(name, folders)


def _find_existing(name: str, origin: str, folders: Sequence[Path], key: str) -> str:
    if key in ("case", "volume.case"):
        try:
            return str(_find_case(name, folders))
        except CaseError as error:
            raise SceneError(f"{origin}: {key}: {error}") from error
    path = Path(os.path.expanduser(name))
    candidates = [path] if path.is_absolute() else [folder / path for folder in folders]
    if key == "path" and not path.is_absolute():
        candidates += [root / "bags" / path for root in shared_roots()]
    for candidate in candidates:
        if os.path.exists(candidate):
            return str(candidate.resolve())
    raise SceneError(f"{origin}: {key}: there is no file {candidates[0]}")
