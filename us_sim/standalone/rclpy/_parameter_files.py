"""Parameter files: YAML of namespaces, node names and `ros__parameters`, wildcards included.

>>> parse_parameter_file("/**: {ros__parameters: {rate: 60.0, image: {width: 512}}}", "p.yaml")
[('/**', 'rate', 60.0), ('/**', 'image.width', 512)]
"""

from pathlib import Path
from typing import Any

import yaml

from ._names import error_in_namespace, error_in_node_name
from ._parameter_values import ParameterSyntaxError, value_of_node

NodeParameter = tuple[str, str, Any]  # node name or wildcard, parameter name, value

_KEY = "ros__parameters"
_LARGEST = 1 << 20
"""Characters of a file."""


def read_parameter_file(path: str) -> list[NodeParameter]:
    """The parameters of a file in the order in which they stand there.

    Raises:
        ParameterSyntaxError: the file cannot be read or is no parameter file.
    """
    try:
        with Path(path).open(encoding="utf-8") as file:  # which may be a pipe
            text = file.read(_LARGEST + 1)
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ParameterSyntaxError(f"Error opening YAML file {path}: {reason}") from None
    if len(text) > _LARGEST:
        raise ParameterSyntaxError(
            f"Error opening YAML file {path}: of its characters {_LARGEST} are read at most"
        )
    return parse_parameter_file(text, path)


def parse_parameter_file(text: str, path: str) -> list[NodeParameter]:
    """As `read_parameter_file`, for text; the path is for messages."""
    try:
        root = yaml.compose(text, Loader=yaml.SafeLoader)
    except yaml.YAMLError as error:
        raise ParameterSyntaxError(f"{path}: {' '.join(str(error).split())}") from None
    if root is None:
        return []
    if not isinstance(root, yaml.MappingNode):
        raise ParameterSyntaxError(f"{path}: expected node names with parameters under them")
    found: list[NodeParameter] = []
    try:
        _walk_names(root, "", found)
    except ParameterSyntaxError as error:
        raise ParameterSyntaxError(f"{path}: {error}") from None
    return found


def _walk_names(mapping: yaml.MappingNode, name: str, found: list[NodeParameter]) -> None:
    for key, value in mapping.value:
        line = key.start_mark.line + 1
        if key.value == _KEY:
            if not name:
                raise ParameterSyntaxError(f"Found '{_KEY}' without a node name at line {line}")
            if not isinstance(value, yaml.MappingNode):
                raise ParameterSyntaxError(f"Expected parameters under '{_KEY}' at line {line}")
            _require_node_name(name, line)
            _walk_parameters(value, name, "", found)
        elif isinstance(value, yaml.MappingNode):
            _walk_names(value, f"{name.rstrip('/')}/{key.value}" if name else key.value, found)
        elif not isinstance(value, yaml.ScalarNode) or value.value:
            raise ParameterSyntaxError(
                f"Cannot have a value before {_KEY} at line {line}; "
                f"put parameters under the node's name and '{_KEY}:'"
            )


def _walk_parameters(
    mapping: yaml.MappingNode, node: str, prefix: str, found: list[NodeParameter]
) -> None:
    for key, value in mapping.value:
        name = f"{prefix}{key.value}"
        if isinstance(value, yaml.MappingNode):
            _walk_parameters(value, node, f"{name}.", found)
        else:
            found.append((node, name, value_of_node(value)))


def _require_node_name(name: str, line: int) -> None:
    """Accept names like node, /ns/node, /**, /*/node and /**/node."""
    absolute = "/" + "/".join(part for part in name.split("/") if part)
    *namespaces, node = absolute[1:].replace("**", "x").replace("*", "x").split("/")
    error = error_in_node_name(node)
    if not error and namespaces:
        error = error_in_namespace("/" + "/".join(namespaces))
    if error:
        raise ParameterSyntaxError(f"'{name}' at line {line}: {error[0]}")
