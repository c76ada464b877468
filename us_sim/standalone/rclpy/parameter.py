"""Parameters: a name, a type and a value.

>>> Parameter("rate", value=60.0).type_.name
'DOUBLE'
>>> Parameter("rate", Parameter.Type.INTEGER, 60.0)
Traceback (most recent call last):
    ...
ValueError: Type 'Type.INTEGER' and value '60.0' do not agree
"""

import array
from enum import Enum
from operator import attrgetter
from typing import Any

from ..messages import message_class

PARAMETER_SEPARATOR_STRING = "."

# bool before int, since a bool is an int; scalar and sequence as in ParameterType
_PYTHON_TYPES: list[tuple[Any, int | None, int]] = [
    (bool, 1, 6),
    (int, 2, 7),
    (float, 3, 8),
    (str, 4, 9),
    (bytes, None, 5),
]


class Parameter:
    """A named value; without a type it has the type of its value."""

    class Type(Enum):
        """The types a parameter can have, with the numbers of rcl_interfaces/msg/ParameterType."""

        NOT_SET = 0
        BOOL = 1
        INTEGER = 2
        DOUBLE = 3
        STRING = 4
        BYTE_ARRAY = 5
        BOOL_ARRAY = 6
        INTEGER_ARRAY = 7
        DOUBLE_ARRAY = 8
        STRING_ARRAY = 9

        @classmethod
        def from_parameter_value(cls, parameter_value: Any) -> "Parameter.Type":
            """The type of a Python value; raises TypeError when parameters cannot have it."""
            if parameter_value is None:
                return cls.NOT_SET
            for python_type, scalar, _ in _PYTHON_TYPES:
                if scalar is not None and isinstance(parameter_value, python_type):
                    return cls(scalar)
            if isinstance(parameter_value, list | tuple | array.array):
                for python_type, _, sequence in (_PYTHON_TYPES[-1], *_PYTHON_TYPES[:-1]):
                    if all(isinstance(item, python_type) for item in parameter_value):
                        return cls(sequence)
                raise TypeError(
                    "The given value is not a list of one of the allowed types "
                    f"'{parameter_value}'."
                )
            raise TypeError(f"The given value is not one of the allowed types '{parameter_value}'.")

        def check(self, parameter_value: Any) -> bool:
            """Whether a Python value is of this type."""
            if self.value == 0:
                return parameter_value is None
            for python_type, scalar, sequence in _PYTHON_TYPES:
                if self.value == scalar:
                    return isinstance(parameter_value, python_type)
                if self.value == sequence:
                    holders = (list, tuple, array.array) if sequence in (7, 8) else (list, tuple)
                    return isinstance(parameter_value, holders) and all(
                        isinstance(item, python_type) and (sequence != 5 or len(item) == 1)
                        for item in parameter_value
                    )
            return False

    name = property(attrgetter("_name"))
    type_ = property(attrgetter("_type"))
    value = property(attrgetter("_value"))

    def __init__(self, name, type_=None, value=None):
        if type_ is None:
            type_ = Parameter.Type.from_parameter_value(value)
        if not isinstance(type_, Parameter.Type):
            raise TypeError(f"type must be an instance of '{Parameter.Type!r}'")
        if not type_.check(value):
            raise ValueError(f"Type '{type_}' and value '{value}' do not agree")
        self._name = name
        self._type = type_
        self._value = value

    @classmethod
    def from_parameter_msg(cls, param_msg):
        """The parameter that a `rcl_interfaces/msg/Parameter` holds."""
        type_ = Parameter.Type(param_msg.value.type)
        return cls(param_msg.name, type_, getattr(param_msg.value, _field(type_), None))

    def get_parameter_value(self):
        """This value as a `rcl_interfaces/msg/ParameterValue`."""
        message: Any = message_class("rcl_interfaces/msg/ParameterValue")(type=self._type.value)
        if self._value is not None:
            setattr(message, _field(self._type), self._value)
        return message

    def to_parameter_msg(self):
        """This parameter as a `rcl_interfaces/msg/Parameter`."""
        cls = message_class("rcl_interfaces/msg/Parameter")
        return cls(name=self._name, value=self.get_parameter_value())

    def __repr__(self) -> str:
        return f"Parameter({self._name!r}, {self._type}, {self._value!r})"


def _field(type_: Parameter.Type) -> str:
    """The field of a `rcl_interfaces/msg/ParameterValue` that holds a value of a type."""
    return f"{type_.name.lower()}_value"
