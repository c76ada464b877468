"""Command-line arguments between `--ros-args` and `--`, and parameter files, parsed as rcl does.

Values differ from YAML's: `1e3` is a number, `yes` and `on` are true, `0x10` is sixteen, a sequence
holds one type only, and a mapping is no value.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from ._names import (
    RemapRule,
    RemapSyntaxError,
    error_in_namespace,
    error_in_node_name,
    parse_remap_rule,
)
from .exceptions import RCLInvalidROSArgsError, UnknownROSArgsError
from .logging import LoggingSeverity

_TRUE = {"Y", "y", "yes", "Yes", "YES", "true", "True", "TRUE", "on", "On", "ON"}
_FALSE = {"N", "n", "no", "No", "NO", "false", "False", "FALSE", "off", "Off", "OFF"}
_NOT_FINITE = re.compile(r"[-+]?\.(nan|NaN|NAN|inf|Inf|INF)")
_INTEGER = re.compile(r"[-+]?(0[xX][0-9a-fA-F]+|[0-9]+)")
_FLOAT = re.compile(
    r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?|[-+]?(inf|nan)(inity)?", re.I
)


class ParameterSyntaxError(ValueError):
    """Text that is no parameter value."""


def parse_value(text: str) -> Any:
    """The bool, int, float, str or list of one of them that the text means.

    Raises:
        ParameterSyntaxError: it is not YAML, empty, a mapping, or a sequence of mixed types.
    """
    try:
        node = yaml.compose(text, Loader=yaml.SafeLoader)
    except yaml.YAMLError as error:
        raise ParameterSyntaxError(" ".join(str(error).split())) from None
    if node is None:
        raise ParameterSyntaxError("No value at line 1")
    return value_of_node(node)


def value_of_node(node: yaml.Node) -> Any:
    """The value that a composed YAML scalar or sequence means; None for an empty sequence."""
    line = node.start_mark.line + 1
    if isinstance(node, yaml.ScalarNode):
        return _scalar(node)
    if not isinstance(node, yaml.SequenceNode):
        raise ParameterSyntaxError(f"Expected a value, found a mapping at line {line}")
    values = []
    for item in node.value:
        if not isinstance(item, yaml.ScalarNode):
            raise ParameterSyntaxError(
                f"Sequences can only be values and not keys in params. Error at line {line}"
            )
        values.append(_scalar(item))
        if type(values[-1]) is not type(values[0]):
            raise ParameterSyntaxError(
                "Sequence should be of same type. "
                f"Value type '{_TYPE_NAMES[type(values[-1])]}' do not belong at line_num {line}"
            )
    return values or None


_TYPE_NAMES = {bool: "bool", int: "integer", float: "double", str: "string"}


def _scalar(node: yaml.ScalarNode) -> bool | int | float | str:
    text = node.value
    if node.style in ("'", '"') or _tagged_as_string(node):
        return text
    if not text:
        raise ParameterSyntaxError(f"No value at line {node.start_mark.line + 1}")
    if text in _TRUE:
        return True
    if text in _FALSE:
        return False
    if _INTEGER.fullmatch(text):
        number = _integer(text)
        if number is not None and -(2**63) <= number < 2**63:
            return number
    if _NOT_FINITE.fullmatch(text):
        return float(text.replace(".", ""))
    if _FLOAT.fullmatch(text):
        return float(text)
    return text


def _integer(text: str) -> int | None:
    """As C's strtoll with base 0: a leading 0 means octal, 0x hexadecimal."""
    digits = text.lstrip("+-")
    if digits[:2] in ("0x", "0X"):
        base = 16
    elif len(digits) > 1 and digits[0] == "0":
        base = 8
    else:
        base = 10
    try:
        return int(text, base)
    except ValueError:  # 09 is no octal number; as a float it is one
        return None


def _tagged_as_string(node: yaml.ScalarNode) -> bool:
    """Whether `!!str` stands before the value (PyYAML marks the node as starting at the tag)."""
    start = node.start_mark
    return (
        node.tag == "tag:yaml.org,2002:str"
        and start.buffer is not None
        and start.buffer[start.pointer] == "!"
    )


NodeParameter = tuple[str, str, Any]  # node name or wildcard, parameter name, value

_KEY = "ros__parameters"
_LARGEST = 1 << 20  # characters of a file


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


_PARAMETER = re.compile(
    r"(?:(?P<node>[A-Za-z_][A-Za-z0-9_]*):(?!=))?(?P<name>[A-Za-z0-9_./~]+?):=(?P<value>.*)", re.S
)
_SWITCH = re.compile(r"--(?P<turn>enable|disable)-(?P<output>rosout|stdout|external-lib)-logs")
_SHORT = {"-p": "--param", "-r": "--remap", "-e": "--enclave"}


@dataclass(frozen=True)
class Arguments:
    """The ROS arguments of a command line."""

    remap_rules: tuple[RemapRule, ...] = ()
    parameters: tuple[NodeParameter, ...] = ()  # later ones override earlier ones
    log_level: LoggingSeverity | None = None
    logger_levels: tuple[tuple[str, LoggingSeverity], ...] = ()
    enclave: str = "/"
    disabled_outputs: frozenset[str] = frozenset()  # of rosout, stdout, external-lib
    others: tuple[str, ...] = ()  # those that are not for ROS, in order

    def overrides_for(self, node: str) -> dict[str, Any]:
        """Parameter values for a node given by its absolute name; wildcards match it."""
        return {
            name: value
            for pattern, name, value in self.parameters
            if _matches(pattern if pattern.startswith("/") else f"/{pattern}", node)
        }


def _matches(pattern: str, node: str) -> bool:
    """Whether /**, /*, /ns/* and the like cover an absolute node name."""
    regex = re.escape(pattern).replace(r"/\*\*", r"(/\w+)*").replace(r"/\*", r"(/\w+)")
    return re.fullmatch(regex, node) is not None


def parse_arguments(args: Sequence[str]) -> Arguments:
    """Parse a whole command line, the program's name included.

    Raises:
        RCLInvalidROSArgsError: a value is malformed or missing.
        UnknownROSArgsError: something between --ros-args and -- is no argument of ROS.
    """
    rules: list[RemapRule] = []
    parameters: list[NodeParameter] = []
    levels: list[tuple[str | None, LoggingSeverity]] = []
    enclaves = ["/"]
    disabled: set[str] = set()
    others: list[str] = []
    unknown: list[str] = []
    takers: dict[str, tuple[str, Callable[[str], Any]]] = {
        "--param": ("parameter override rule", lambda text: parameters.append(_parameter(text))),
        "--remap": ("remap rule", lambda text: rules.append(parse_remap_rule(text))),
        "--params-file": ("params file", lambda text: parameters.extend(read_parameter_file(text))),
        "--log-level": ("log level", lambda text: levels.append(_level(text))),
        "--enclave": ("enclave name", enclaves.append),
        "--log-config-file": ("log configuration file", lambda _: None),
        "--log-file-name": ("log file name prefix", lambda _: None),
    }
    for_ros = False
    remaining = iter(args)
    for argument in remaining:
        if argument == "--ros-args":
            for_ros = True
        elif not for_ros:
            others.append(argument)
        elif argument == "--":
            for_ros = False
        elif (flag := _SHORT.get(argument, argument)) in takers:
            kind, take = takers[flag]
            value = next(remaining, None)
            if value is None:
                raise RCLInvalidROSArgsError(
                    f"Failed to parse ROS arguments: Couldn't parse trailing {argument} flag. "
                    f"No {kind} found."
                )
            try:
                take(value)
            except (ParameterSyntaxError, RemapSyntaxError, ValueError) as error:
                raise RCLInvalidROSArgsError(
                    f"Failed to parse ROS arguments: Couldn't parse {kind}: "
                    f"'{argument} {value}'. Error: {error}"
                ) from None
        elif switch := _SWITCH.fullmatch(argument):
            (disabled.add if switch["turn"] == "disable" else disabled.discard)(switch["output"])
        else:
            unknown.append(argument)
    if unknown:
        raise UnknownROSArgsError(repr(unknown))
    return Arguments(
        remap_rules=tuple(rules),
        parameters=tuple(parameters),
        log_level=next((level for name, level in reversed(levels) if name is None), None),
        logger_levels=tuple((name, level) for name, level in levels if name is not None),
        enclave=enclaves[-1],
        disabled_outputs=frozenset(disabled),
        others=tuple(others),
    )


def _parameter(text: str) -> NodeParameter:
    found = _PARAMETER.fullmatch(text)
    if found is None:
        raise ParameterSyntaxError("Expected [node:]name:=value")
    return found["node"] or "/**", found["name"], parse_value(found["value"])


def _level(text: str) -> tuple[str | None, LoggingSeverity]:
    name, separator, level = text.rpartition(":=")
    if separator and not name:
        raise ValueError("Argument has an invalid logger item that name is empty")
    if level.upper() not in LoggingSeverity.__members__:
        raise ValueError("Argument does not use a valid severity level")
    return name or None, LoggingSeverity[level.upper()]
