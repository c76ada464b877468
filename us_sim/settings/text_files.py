r"""YAML that a person wrote, each key once.

>>> from us_sim.settings.text_files import load_yaml
>>> load_yaml("probe: {depth: 4 cm}")
{'probe': {'depth': '4 cm'}}
>>> load_yaml("depth: 4 cm\ndepth: 5 cm")
Traceback (most recent call last):
us_sim.settings.text_files.YamlError: line 2: key `depth` is there twice, first in line 1: keep one
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from us_sim.errors import UsSimError

LARGEST_YAML = 1 << 20  # characters of a text that is read


class YamlError(UsSimError):
    """A text is not YAML, or more than is read; the sentence begins with the line where it can."""


def load_yaml(text: str) -> Any:
    """Parse a YAML text into Python's own types.

    Raises:
        YamlError: it is not YAML, has a key twice, is larger than `LARGEST_YAML`, or is nested too
            deeply.
    """
    if len(text) > LARGEST_YAML:
        raise YamlError(
            f"has {len(text)} characters, of which {LARGEST_YAML} are read at most: shorten it"
        )
    try:
        return yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        problem = str(getattr(error, "problem", None) or "unreadable")
        mark = getattr(error, "problem_mark", None)
        if not isinstance(error, _RepeatedKey):
            problem = f"is not YAML: {problem}"
        raise YamlError(f"line {mark.line + 1}: {problem}" if mark else problem) from error
    # PyYAML lets those of dates and numbers pass that are none.
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError) as error:
        raise YamlError(f"is not YAML: {error}") from error


def read_yaml(path: Path, error_type: type[UsSimError]) -> Any:
    """Parse a YAML file into Python's own types; errors name the file.

    Raises:
        UsSimError: of that type, it cannot be read, or as `load_yaml`.
    """
    try:
        return load_yaml(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise error_type(f"{path}: cannot be read: {error}") from error
    except YamlError as error:
        raise error_type(f"{path}: {error}") from error


class _RepeatedKey(yaml.constructor.ConstructorError):
    """A mapping that has a key twice."""


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
