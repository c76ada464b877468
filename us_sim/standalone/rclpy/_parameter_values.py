"""YAML scalars and sequences as parameter values, by the rules of rcl's own parser.

They differ from YAML's: `1e3` is a number, `yes` and `on` are true, `0x10` is sixteen, a sequence
holds one type only, and a mapping is no value.

>>> parse_value("[1.5, 2e3]"), parse_value("on"), parse_value("'on'")
([1.5, 2000.0], True, 'on')
"""

import re
from typing import Any

import yaml

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
