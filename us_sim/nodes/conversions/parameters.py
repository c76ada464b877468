"""Parameters of other nodes: their descriptors and values, read and written.

The nodes of this package say more in a descriptor than ROS has fields for, in sentences that
`ros2 param describe` shows: the unit behind the description, and constraints such as
``one of fem, msds; 0 for none; may change while running; shown in mm; fem: linear elasticity``.
Others need not.
"""

from __future__ import annotations

import re
from array import array
from typing import Any

from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterDescriptor, ParameterType, ParameterValue

from us_sim.settings.amount import dial_unit
from us_sim.settings.quantity import Quantity, units_of
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
_UNIT_BEHIND = re.compile(r"^(.*?)\s*\(([^()]*(?:\([^()]*\))?[^()]*)\)$", re.DOTALL)
_ONE_OF, _SHOWN_IN = "one of ", "shown in "
_NOTHING = ("0 for none", "'' for none")
_DIMENSIONS = {"m": "length", "Pa": "pressure", "rad": "angle", "rad/s": "angular speed"}
"""Of units that a person reads otherwise, where a descriptor does not say how."""


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
    said = [each.strip() for each in str(descriptor.additional_constraints).split(";")]
    description, unit = _description(str(descriptor.description))
    limits = _limits(descriptor)
    reads = next((each[len(_SHOWN_IN) :] for each in said if each.startswith(_SHOWN_IN)), "")
    if reads not in units_of(unit):
        dimension = _DIMENSIONS.get(unit)
        reads = dial_unit(Quantity(dimension)) if dimension and kind is Kind.NUMBER else unit
    listed = next((each[len(_ONE_OF) :] for each in said if each.startswith(_ONE_OF)), "")
    choices = tuple(each.strip() for each in listed.split(",") if each.strip())
    told = (each.partition(": ") for each in said)
    return Parameter(
        node,
        name,
        kind,
        raw,
        unit=reads,
        size=units_of(unit).get(reads, 1.0),
        limits=limits,
        choices=choices,
        meanings={name: text for name, _, text in told if name in choices and text},
        may_be_nothing=any(each in _NOTHING for each in said),
        description=description,
        is_live=not descriptor.read_only and kind is not Kind.OTHER,
    )


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


def _description(text: str) -> tuple[str, str]:
    """The description and the SI unit behind it, if there is one."""
    match = _UNIT_BEHIND.match(text)
    if match and units_of(match[2]):
        return match[1], match[2]
    return text, ""


def _limits(descriptor: ParameterDescriptor) -> tuple[float, float] | None:
    ranges = [*descriptor.floating_point_range, *descriptor.integer_range]
    return (float(ranges[0].from_value), float(ranges[0].to_value)) if ranges else None
