"""Text files and YAML that a person or a stranger wrote, of limited size, each key once.

>>> from us_sim.settings.text_files import load_yaml, read_text
>>> read_text("/dev/zero")
Traceback (most recent call last):
    ...
OSError: [Errno 27] more than 64 MiB, and no text is so long: '/dev/zero'
>>> load_yaml("probe: {depth: 4 cm}")
{'probe': {'depth': '4 cm'}}
>>> load_yaml("depth: 4 cm\\ndepth: 5 cm")
Traceback (most recent call last):
us_sim.settings.text_files.YamlError: line 2: key `depth` is there twice, first in line 1: keep one
"""

from __future__ import annotations

import errno
from pathlib import Path
from typing import Any

import yaml

from us_sim.errors import UsSimError

_LARGEST = 64 << 20


def read_text(path: Path | str, encoding: str = "utf-8", errors: str = "strict") -> str:
    """The text of a file, or of a pipe, that is not endless.

    Raises:
        OSError: it cannot be read, or has more than 64 MiB.
        UnicodeDecodeError: it is no text of that encoding.
    """
    return read_bytes(path).decode(encoding, errors)


def read_bytes(path: Path | str) -> bytes:
    """Likewise, of a text whose encoding is said in it."""
    with Path(path).open("rb") as file:
        data = file.read(_LARGEST + 1)
    if len(data) > _LARGEST:
        raise OSError(errno.EFBIG, "more than 64 MiB, and no text is so long", str(path))
    return data


LARGEST_YAML = 1 << 20
"""Characters of a text that is read."""

MOST_NODES = 100_000
"""Values, keys, lists and mappings of a text, where every alias counts as what it stands for."""

_DEEPEST = 64
"""Lists and mappings within each other."""

_LONGEST_NUMBER = 100
"""Characters; PyYAML takes a minute for 1:1:1:… with a million of them."""


class YamlError(UsSimError):
    """A text is not YAML, or more than is read; the sentence begins with the line where it can."""


def load_yaml(text: str) -> Any:
    """The content of a YAML text, in Python's own types.

    Raises:
        YamlError: it is not YAML, has a key twice, is larger than `LARGEST_YAML` or holds more
            than `MOST_NODES`, is nested too deeply, or has an alias within what it stands for.
    """
    if len(text) > LARGEST_YAML:
        raise YamlError(
            f"has {len(text)} characters, of which {LARGEST_YAML} are read at most: shorten it"
        )
    try:
        _check(text)
        return yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        problem = str(getattr(error, "problem", None) or "unreadable")
        mark = getattr(error, "problem_mark", None)
        if not isinstance(error, _RepeatedKey):
            problem = f"is not YAML: {problem}"
        raise YamlError(f"line {mark.line + 1}: {problem}" if mark else problem) from error
    # PyYAML lets those of dates and numbers pass that are none.
    except (ValueError, TypeError, LookupError, AttributeError, ArithmeticError) as error:
        raise YamlError(f"is not YAML: {error}") from error


def read_yaml(path: Path, error_type: type[UsSimError], label: Path | None = None) -> Any:
    """The content of a YAML file, in Python's own types; errors name it, or the label.

    Raises:
        UsSimError: of that type, it cannot be read, or as `load_yaml`.
    """
    try:
        return load_yaml(read_text(path))
    except (OSError, UnicodeDecodeError) as error:
        raise error_type(f"{label or path}: cannot be read: {error}") from error
    except YamlError as error:
        raise error_type(f"{label or path}: {error}") from error


def _check(text: str) -> None:
    """Count the values in a text without making any of them."""
    sizes: list[int] = [0]  # of what is open
    names: list[str | None] = []  # their anchors
    anchored: dict[str, int] = {}
    event: Any  # of a class by what it is
    for event in yaml.parse(text, _Loader):
        line = event.start_mark.line + 1
        size = 0
        if isinstance(event, yaml.AliasEvent):
            if event.anchor in names:
                raise YamlError(
                    f"line {line}: is not YAML that can be read: `*{event.anchor}` is within itself"
                )
            size = anchored.get(str(event.anchor), 1)
        elif isinstance(event, yaml.ScalarEvent):
            size = 1
            if event.anchor:
                anchored[event.anchor] = 1
        elif isinstance(event, yaml.CollectionStartEvent):
            sizes.append(1)
            names.append(event.anchor)
            if len(names) > _DEEPEST:
                raise YamlError(
                    f"line {line}: has more than {_DEEPEST} lists and mappings within each other"
                )
        elif isinstance(event, yaml.CollectionEndEvent):
            size = sizes.pop()
            name = names.pop()
            if name:
                anchored[name] = size
        sizes[-1] += size
        if sizes[-1] > MOST_NODES:
            raise YamlError(
                f"line {line}: holds more than {MOST_NODES} values up to here, those that aliases "
                f"repeat included: shorten it"
            )


class _RepeatedKey(yaml.constructor.ConstructorError):
    """A mapping has a key twice."""


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Loader that refuses repeated keys, which YAML forbids and PyYAML lets pass."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        lines: dict[Any, int] = {}
        for key_node, _ in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                continue
            line = key_node.start_mark.line + 1
            key = "<<" if key_node.tag.endswith(":merge") else self.construct_object(key_node)
            if key in lines:
                problem = f"key `{key}` is there twice, first in line {lines[key]}: keep one"
                raise _RepeatedKey(None, None, problem, key_node.start_mark)
            lines[key] = line
        made: dict[Any, Any] = super().construct_mapping(node, deep)
        return made

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int:
        _check_number(node)
        return int(super().construct_yaml_int(node))

    def construct_yaml_float(self, node: yaml.ScalarNode) -> float:
        _check_number(node)
        return float(super().construct_yaml_float(node))


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_yaml_int)
_Loader.add_constructor("tag:yaml.org,2002:float", _Loader.construct_yaml_float)


def _check_number(node: yaml.ScalarNode) -> None:
    if len(node.value) > _LONGEST_NUMBER:
        problem = f"a number of {len(node.value)} characters"
        raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark)
