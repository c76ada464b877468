"""Parameters of other nodes: their descriptors and values, read and written.

The nodes of this package say more in a descriptor than ROS has fields for, as a JSON object in
``additional_constraints``, see `us_sim.nodes.parameters`. Others may write there what they like.
"""

from __future__ import annotations

import json
from array import array
from typing import Any

from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterDescriptor, ParameterType, ParameterValue

from us_sim.settings.quantity import units_of
from us_sim.viewer.parameters import Kind, Parameter

_TYPES: dict[Kind, tuple[int, str]] = {
    Kind.TRUTH: (ParameterType.PARAMETER_BOOL, "bool_value"),
    Kind.WHOLE: (ParameterType.PARAMETER_INTEGER, "integer_value"),
    Kind.NUMBER: (ParameterType.PARAMETER_DOUBLE, "double_value"),
    Kind.TEXT: (ParameterType.PARAMETER_STRING, "string_value"),
    Kind.WHOLES: (ParameterType.PARAMETER_INTEGER_ARRAY, "integer_array_value"),
    Kind.NUMBERS: (ParameterType.PARAMETER_DOUBLE_ARRAY, "double_array_value"),
    Kind.TEXTS: (ParameterType.PARAMETER_STRING_ARRAY, "string_array_value"),
}
_KINDS = {number: (kind, field) for kind, (number, field) in _TYPES.items()}


def parameter_from(
    node: str, name: str, descriptor: ParameterDescriptor, value: ParameterValue
) -> Parameter:
    """What a page shows of a parameter.

    Args:
        node: whose it is.
        name: of the parameter.
        descriptor, value: what the node says of it.
    """
    kind, raw = raw_from(value)
    told = _extras(descriptor)
    unit, reads = str(told.get("unit", "")), str(told.get("shown_in", ""))
    choices = told.get("choices")
    meanings = {str(k): str(v) for k, v in choices.items()} if isinstance(choices, dict) else {}
    limits = _limits(descriptor)
    if reads not in units_of(unit):
        reads = unit
    return Parameter(
        node,
        name,
        kind,
        raw,
        unit=reads,
        size=units_of(unit).get(reads, 1.0),
        limits=limits,
        choices=tuple(meanings),
        meanings={name: text for name, text in meanings.items() if text},
        may_be_nothing="none" in told,
        description=str(descriptor.description),
        is_live=not descriptor.read_only and kind is not Kind.OTHER,
    )


def _extras(descriptor: ParameterDescriptor) -> dict[str, Any]:
    """The JSON object in the constraints; nothing where another's node has something else there."""
    try:
        told = json.loads(str(descriptor.additional_constraints))
    except (ValueError, RecursionError):
        return {}
    return told if isinstance(told, dict) else {}


def raw_from(value: ParameterValue) -> tuple[Kind, Any]:
    """The kind and the value in SI units; lists are tuples."""
    if value.type not in _KINDS:
        return Kind.OTHER, None
    kind, field = _KINDS[value.type]
    raw = getattr(value, field)
    return kind, tuple(raw) if kind.is_list else raw


def parameter_message(parameter: Parameter, raw: Any) -> ParameterMessage:
    """What asks the parameter's node to set it to a value in SI units."""
    number, field = _TYPES[parameter.kind]
    if parameter.kind is Kind.NUMBERS:
        raw = array("d", raw)
    elif parameter.kind.is_list:
        raw = list(raw)
    value = ParameterValue(type=number, **{field: raw})
    return ParameterMessage(name=parameter.name, value=value)


def _limits(descriptor: ParameterDescriptor) -> tuple[float, float] | None:
    ranges = [*descriptor.floating_point_range, *descriptor.integer_range]
    return (float(ranges[0].from_value), float(ranges[0].to_value)) if ranges else None
