"""The YAML of a scene, with that of the scene it is based on.

>>> from us_sim.scene.document import merged
>>> merged({"probe": {"depth": "4 cm", "lines": 128}, "skin": {}},
...        {"probe": {"depth": "6 cm"}, "skin": None})
{'probe': {'depth': '6 cm', 'lines': 128}, 'skin': None}
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from us_sim.errors import SceneError

__all__ = ["merged", "read_document"]

DIMENSIONS = {
    "geometry": ("aperture", "radius", "opening_angle"),
    "shape": ("radius", "length", "width", "height", "rounding"),
}
"""Keys that say of which kind a probe or a collider is, and those that depend on it."""
BASE = "based_on"
"""The key that names another scene; what a scene says goes before what its base says."""


def read_document(
    path: Path, find: Callable[[str | Path], Path], seen: tuple[Path, ...] = ()
) -> tuple[Any, list[Path]]:
    """The document of a scene file, and the folders in which its relative files are looked up.

    Args:
        find: gives the file of the scene of a name.
        seen: files that are based on this one.

    Raises:
        SceneError: it cannot be read, is not YAML, or is based on itself.
    """
    document: Any = _yaml(path)
    folders = [path.parent]
    if not isinstance(document, dict) or BASE not in document:
        return document, folders
    name = document.pop(BASE)
    if not isinstance(name, str) or not name:
        raise SceneError(f"{path}: {BASE}: must be a scene's file or name, not {name!r}")
    beside = path.parent / name
    try:
        base = beside.resolve() if beside.is_file() else find(name)
    except SceneError as error:
        raise SceneError(f"{path}: {BASE}: {error}") from error
    if base in (*seen, path):
        raise SceneError(f"{path}: {BASE}: {base} is based on this scene itself")
    below: Any
    below, more = read_document(base, find, (*seen, path))
    if not isinstance(below, dict):
        raise SceneError(f"{path}: {BASE}: {base} is no mapping of keys")
    return merged(below, document), [*folders, *more]


def merged(below: dict[Any, Any], above: dict[Any, Any]) -> dict[Any, Any]:
    """``below`` with what ``above`` says: mappings key by key, anything else replaced.

    Where ``above`` names another geometry or shape, the dimensions of the one below go with it.
    """
    result = dict(below)
    for kind, dimensions in DIMENSIONS.items():
        if kind in above and above[kind] != below.get(kind):
            result = {key: value for key, value in result.items() if key not in dimensions}
    for key, value in above.items():
        under = result.get(key)
        if isinstance(under, dict) and isinstance(value, dict):
            value = merged(under, value)
        result[key] = value
    return result


def _yaml(path: Path) -> Any:
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"{path}: cannot be read: {error}") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" line {mark.line + 1}:" if mark else ""
        problem = getattr(error, "problem", None) or "unreadable"
        raise SceneError(f"{path}:{where} is not YAML: {problem}") from error
