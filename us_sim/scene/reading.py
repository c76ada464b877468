"""Reading a scene file: YAML to :class:`us_sim.scene.scene.Scene`, every key and value checked.

>>> from us_sim.scene.reading import parse_scene
>>> scene = parse_scene({"name": "bare", "volume": {"phantom": "upper_arm"},
...                      "probe": {"aperture": "40 mm", "depth": "40 mm"}})
>>> [part.node for part in scene.parts() if part.needed]
['probe_tracker', 'slice_interpolator']
"""

from __future__ import annotations

import dataclasses
import difflib
import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from us_sim.errors import SceneError, UsSimError
from us_sim.scene.building import probe_of
from us_sim.scene.document import read_document
from us_sim.scene.scene import PoseSection, Scene, TissueSection, VolumeSection
from us_sim.settings.quantity import Quantity
from us_sim.share import shared_roots

__all__ = ["find_scene", "load_scene", "parse_scene"]


def find_scene(name: str | Path) -> Path:
    """The scene file of that path, or of that name in ``config/scenes``.

    Raises:
        SceneError: there is no such file; the sentence lists the installed scenes.
    """
    path = Path(name).expanduser()
    if path.is_file():
        return path.resolve()
    known: dict[str, Path] = {}
    for root in shared_roots():
        for file in sorted((root / "config" / "scenes").glob("*.yaml")):
            known.setdefault(file.stem, file)
    stem = path.name.removesuffix(".yaml")
    if str(path) in (stem, f"{stem}.yaml") and stem in known:
        return known[stem]
    raise SceneError(f"there is no scene file {name}; installed scenes are {', '.join(known)}")


def load_scene(name: str | Path, *, volume: str | Path | None = None) -> Scene:
    """Read and validate a scene file; ``volume`` replaces the file it names.

    Raises:
        SceneError: the file or a value in it cannot be used; one sentence with file and key.
    """
    path = find_scene(name)
    document, folders = read_document(path, find_scene)
    if volume:
        if not isinstance(document, dict) or not isinstance(document.get("volume"), dict):
            raise SceneError(f"{path}: volume: must be a mapping of keys")
        document["volume"] = {
            key: value for key, value in document["volume"].items() if key != "phantom"
        } | {"file": str(Path(volume).expanduser().resolve())}
    return parse_scene(document, origin=str(path), folders=folders)


def parse_scene(document: object, *, origin: str = "scene", folders: Sequence[Path] = ()) -> Scene:
    """Validate an already read document; relative files are looked up in ``folders``.

    Raises:
        SceneError: see :func:`load_scene`.
    """
    scene: Scene = _build(Scene, _with_named_structures(document), origin, "")
    scene = dataclasses.replace(scene, origin=origin)
    _check_volume(scene.volume, origin)
    probe_of(scene)
    if scene.tissue is not None:
        _check_tissue(scene, scene.tissue, origin)
    _check_structures(scene, origin)
    if scene.skin is not None and scene.probe.collider is None:
        raise SceneError(
            f"{origin}: probe.collider: is missing, and the skin needs one to press it"
        )
    resolved: Scene = _resolve_files(scene, origin, [*folders, Path.cwd()])
    return resolved


def _with_named_structures(document: object) -> object:
    """Structures that have nothing but a name may be a list of names, or keys without a value."""
    if not isinstance(document, dict) or "structures" not in document:
        return document
    given = document["structures"]
    if isinstance(given, list) and all(isinstance(name, str) for name in given):
        given = dict.fromkeys(given)
    if isinstance(given, dict):
        given = {name: {} if value is None else value for name, value in given.items()}
    return document | {"structures": given}


def _build(cls: type, document: object, origin: str, key: str) -> Any:
    """An instance of the dataclass ``cls`` from a mapping, every key checked."""
    at = f"{origin}: {key + ': ' if key else ''}"
    if document is None and not key:
        raise SceneError(f"{origin}: is empty; a scene has at least name, volume and probe")
    if not isinstance(document, dict):
        raise SceneError(f"{at}must be a mapping of keys, not {document!r}")
    fields = {f.name: f for f in dataclasses.fields(cls) if f.metadata}
    for name in document:
        if name not in fields:
            near = difflib.get_close_matches(str(name), fields, n=1)
            hint = f"did you mean `{near[0]}`?" if near else f"known keys: {', '.join(fields)}"
            raise SceneError(f"{at}unknown key `{name}`; {hint}")
    types = get_type_hints(cls)
    values = {}
    for name, entry in fields.items():
        path = f"{key}.{name}" if key else name
        if name in document:
            values[name] = _value(types[name], document[name], entry.metadata, origin, path)
        elif entry.default is dataclasses.MISSING and entry.default_factory is dataclasses.MISSING:
            raise SceneError(f"{origin}: {path}: is missing")
    try:
        return cls(**values)
    except SceneError:
        raise
    except UsSimError as error:  # values that do not go together
        raise SceneError(f"{origin}: {error}") from error


def _value(kind: Any, value: object, check: Any, origin: str, key: str) -> Any:
    """``value`` converted to the type ``kind``, checked against its quantity or choices."""
    at = f"{origin}: {key}: "
    if get_origin(kind) in (Union, UnionType):
        if value is None:
            return None
        options = [option for option in get_args(kind) if option is not type(None)]
        kind = next((option for option in options if _suits(option, value)), options[0])
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        return _build(kind, value, origin, key)
    if get_origin(kind) is tuple:
        return _sequence(get_args(kind), value, check, origin, key)
    if get_origin(kind) is dict:
        if not isinstance(value, dict):
            raise SceneError(f"{at}must be a mapping of keys, not {value!r}")
        inner = get_args(kind)[1]
        return {str(k): _value(inner, v, check, origin, f"{key}.{k}") for k, v in value.items()}
    if kind in (int, float):
        quantity: Quantity = check["quantity"] or Quantity("number")
        try:
            number = quantity.parse(value)
        except ValueError as error:
            raise SceneError(f"{at}{error}") from error
        if kind is int and number != int(number):
            raise SceneError(f"{at}{value!r} is not a whole number")
        return kind(number)
    if kind is bool:
        if not isinstance(value, bool):
            raise SceneError(f"{at}must be true or false, not {value!r}")
        return value
    if kind is str:
        if not isinstance(value, str) or not value:
            raise SceneError(f"{at}must be a text, not {value!r}")
        if check["choices"] and value not in check["choices"]:
            raise SceneError(f"{at}{value!r} is not one of {', '.join(check['choices'])}")
    return value


def _suits(kind: Any, value: object) -> bool:
    """Whether a value looks like one of that type, where several are possible."""
    if isinstance(value, list):
        return get_origin(kind) is tuple
    if isinstance(value, dict):
        return dataclasses.is_dataclass(kind)
    return kind is str if isinstance(value, str) else kind in (int, float)


def _sequence(kinds: tuple[Any, ...], value: object, check: Any, origin: str, key: str) -> Any:
    at = f"{origin}: {key}: "
    if not isinstance(value, list):
        raise SceneError(f"{at}must be a list, not {value!r}")
    if kinds[-1] is Ellipsis:
        kinds = kinds[:1] * len(value)
    if len(value) != len(kinds):
        raise SceneError(f"{at}needs {len(kinds)} values, not {len(value)}")
    return tuple(
        _value(kind, item, check, origin, f"{key}[{i}]")
        for i, (kind, item) in enumerate(zip(kinds, value, strict=True))
    )


def _check_volume(volume: VolumeSection, origin: str) -> None:
    if volume.file and volume.phantom:
        raise SceneError(f"{origin}: volume: has both `file` and `phantom`; keep one")
    if not volume.file and not volume.phantom:
        raise SceneError(
            f"{origin}: volume.file: is missing; name a file there, or give one with --volume"
        )


def _check_tissue(scene: Scene, tissue: TissueSection, origin: str) -> None:
    if scene.probe.collider is None:
        raise SceneError(
            f"{origin}: probe.collider: is missing, and the tissue needs one to press it"
        )
    if not tissue.materials:
        raise SceneError(f"{origin}: tissue.materials: names no material")
    mesh = tissue.mesh
    box = {"lower": mesh.lower, "upper": mesh.upper, "planes": mesh.planes or None}
    if mesh.file is not None:
        for key, value in box.items():
            if value is not None:
                raise SceneError(f"{origin}: tissue.mesh: has both `file` and `{key}`; keep one")
        return
    if mesh.lower is None or mesh.upper is None:
        missing = "lower" if mesh.lower is None else "upper"
        raise SceneError(
            f"{origin}: tissue.mesh.{missing}: is missing; give the corners of a box, or a `file`"
        )
    if mesh.unit != 1.0 or mesh.pose != PoseSection() or mesh.margin is not None:
        raise SceneError(
            f"{origin}: tissue.mesh: `unit`, `pose` and `margin` are for a mesh from a `file` only"
        )
    for axis, name in enumerate("xyz"):
        if mesh.lower[axis] >= mesh.upper[axis]:
            raise SceneError(
                f"{origin}: tissue.mesh.upper[{axis}]: {mesh.upper[axis]:g} m is not above "
                f"tissue.mesh.lower[{axis}], {mesh.lower[axis]:g} m"
            )
        planes = mesh.planes.get(name)
        if planes is not None and (
            len(planes) < 2 or any(b <= a for a, b in itertools.pairwise(planes))
        ):
            raise SceneError(
                f"{origin}: tissue.mesh.planes.{name}: needs two or more rising coordinates"
            )
        if planes is not None and not (
            len(planes) == mesh.nodes[axis]
            and math.isclose(planes[0], mesh.lower[axis], abs_tol=1e-9)
            and math.isclose(planes[-1], mesh.upper[axis], abs_tol=1e-9)
        ):
            raise SceneError(
                f"{origin}: tissue.mesh.planes.{name}: must be {mesh.nodes[axis]} coordinates from "
                f"{mesh.lower[axis]:g} to {mesh.upper[axis]:g} m, as nodes, lower and upper say"
            )
    for axis_name in mesh.planes:
        if axis_name not in ("x", "y", "z"):
            raise SceneError(f"{origin}: tissue.mesh.planes: unknown axis `{axis_name}`")


def _check_structures(scene: Scene, origin: str) -> None:
    if scene.structures and scene.tissue is None:
        raise SceneError(f"{origin}: structures: need `tissue` to carry them, and it is missing")
    for name, given in scene.structures.items():
        key = f"{origin}: structures.{name}"
        if given.file and given.label:
            raise SceneError(f"{key}: has both `file` and `label`; keep one")
        if not given.file and (given.unit != 1.0 or given.pose != PoseSection()):
            raise SceneError(f"{key}: `unit` and `pose` are for a surface from a `file` only")


def _resolve_files(section: Any, origin: str, folders: Sequence[Path], key: str = "") -> Any:
    """A section, and those in it, with absolute paths of files that are there."""
    changes: dict[str, Any] = {}
    for entry in dataclasses.fields(section):
        value = getattr(section, entry.name)
        name = f"{key}.{entry.name}" if key else entry.name
        if isinstance(value, str) and value and entry.metadata.get("file"):
            changes[entry.name] = _existing(value, origin, folders, name)
        elif dataclasses.is_dataclass(value):
            changes[entry.name] = _resolve_files(value, origin, folders, name)
        elif isinstance(value, dict):
            changes[entry.name] = {
                k: _resolve_files(v, origin, folders, f"{name}.{k}")
                if dataclasses.is_dataclass(v)
                else v
                for k, v in value.items()
            }
    return dataclasses.replace(section, **changes)


def _existing(name: str, origin: str, folders: Sequence[Path], key: str) -> str:
    """The absolute path of a file named in a scene."""
    path = Path(name).expanduser()
    candidates = [path] if path.is_absolute() else [folder / path for folder in folders]
    if key == "path" and not path.is_absolute():
        candidates += [root / "bags" / path for root in shared_roots()]
    for candidate in candidates:
        if candidate.exists():
            return str(candidate.resolve())
    raise SceneError(f"{origin}: {key}: there is no file {candidates[0]}")
