"""The YAML of a scene, with that of the scene it is based on.

>>> from us_sim.scene.document import merged
>>> merged({"probe": {"depth": "4 cm", "lines": 128}, "skin": {}},
...        {"probe": {"depth": "6 cm"}, "skin": None})
{'probe': {'depth': '6 cm', 'lines': 128}}
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin

from us_sim.errors import SceneError
from us_sim.scene.scene import Scene
from us_sim.settings.choice import Choice
from us_sim.settings.setting import Settings, kinds_of, rules_of
from us_sim.settings.text_files import LARGEST_YAML, YamlError, load_yaml, read_text

BASE = "based_on"
"""The key that names another scene; what a scene says goes before what its base says."""

_LONGEST_CHAIN = 20
"""Scenes, each based on the next."""


def read_document(
    path: Path, find: Callable[[str | Path], Path], seen: tuple[Path, ...] = ()
) -> tuple[Any, list[Path]]:
    """The document of a scene file, and the folders in which its relative files are looked up.

    Args:
        find: gives the file of the scene of a name.
        seen: files that are based on this one.

    Raises:
        SceneError: it cannot be read, is not YAML, is based on itself, or on too many.
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
        base = beside.resolve() if os.path.isfile(beside) else find(name)
    except SceneError as error:
        raise SceneError(f"{path}: {BASE}: {error}") from error
    if base in (*seen, path):
        raise SceneError(f"{path}: {BASE}: {base} is based on this scene itself")
    if len(seen) == _LONGEST_CHAIN:
        raise SceneError(
            f"{path}: {BASE}: {seen[0]} is based on more than {_LONGEST_CHAIN} scenes, one on the "
            f"other: write some of them as one"
        )
    below: Any
    below, more = read_document(base, find, (*seen, path))
    if not isinstance(below, dict):
        raise SceneError(f"{path}: {BASE}: {base} is no mapping of keys")
    return merged(below, document), [*folders, *more]


def merged(below: dict[Any, Any], above: dict[Any, Any]) -> dict[Any, Any]:
    """``below`` with what ``above`` says: mappings key by key, anything else replaced.

    Where ``above`` chooses another kind of probe, collider, filter, ..., what only some kinds have
    goes with the one below; where it names a file in place of a box, the box goes. ``null`` takes
    back what ``below`` says.
    """
    return _merged(below, above, Scene)


def _merged(
    below: dict[Any, Any],
    above: dict[Any, Any],
    settings: type[Settings] | None,
    choice: Choice | None = None,
    each: Any = None,
) -> dict[Any, Any]:
    """Two mappings merged, of the settings or the choice whose keys they hold.

    Args:
        each: the type of what is under any key, where keys are names that a person chose.
    """
    gone = _no_longer(below, above, choice) if choice else set()
    rules = rules_of(settings) if settings else {}
    gone |= _replaced(above, settings.alternatives) if settings else set()
    gone |= {key for key, value in above.items() if value is None}
    for rule in rules.values():
        if rule.choice and rule.place == "beside":
            gone |= _no_longer(below, above, rule.choice)
        elif rule.choice and rule.place == "named" and _changes(below, above, rule.choice):
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
            value = _merged(under, value, _settings_in(kind), chosen, _kind_of_each(kind))
        if value is not None or key not in below:
            result[key] = value
    return result


def _replaced(above: dict[Any, Any], alternatives: Mapping[str, tuple[str, ...]]) -> set[str]:
    """The keys in whose place ``above`` names something, if it names one thing."""
    named = [name for name in alternatives if above.get(name) is not None]
    if len(named) != 1:
        return set()
    others = {key for name, own in alternatives.items() for key in (name, *own)}
    return others - {named[0], *alternatives[named[0]]}


def _changes(below: dict[Any, Any], above: dict[Any, Any], choice: Choice) -> bool:
    return choice.key in above and above[choice.key] != below.get(choice.key)


def _no_longer(below: dict[Any, Any], above: dict[Any, Any], choice: Choice) -> set[str]:
    """The keys that not all options have, if another option is chosen."""
    if not _changes(below, above, choice):
        return set()
    keys = [set(rules_of(choice.settings(name))) for name in choice.names]
    return set().union(*keys) - keys[0].intersection(*keys)


def _settings_in(kind: Any) -> type[Settings] | None:
    options = get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
    for option in options:
        if isinstance(option, type) and issubclass(option, Settings):
            return option
    return None


def _kind_of_each(kind: Any) -> Any:
    return get_args(kind)[1] if get_origin(kind) in (dict, Mapping) else None


def _yaml(path: Path) -> Any:
    try:
        if path.stat().st_size > 4 * LARGEST_YAML:  # bytes of a character at most
            raise SceneError(
                f"{path}: has {path.stat().st_size} bytes, which is no scene: name one that is"
            )
        return load_yaml(read_text(path))
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"{path}: cannot be read: {error}") from error
    except YamlError as error:
        raise SceneError(f"{path}: {error}") from error
