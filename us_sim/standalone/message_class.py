"""Python classes for messages that behave like those rosidl generates.

Assignments are checked as rosidl does with ``ROS_PYTHON_CHECK_FIELDS=1``: what a real node would
publish as garbage, or crash on, raises an AssertionError here.

>>> from us_sim.standalone.message_class import message_class
>>> Quaternion = message_class("geometry_msgs/msg/Quaternion")
>>> Quaternion(z=0.5)
geometry_msgs.msg.Quaternion(x=0.0, y=0.0, z=0.5, w=1.0)
>>> Quaternion(z=1)
Traceback (most recent call last):
AssertionError: The 'z' field must be of type 'float'
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable
from functools import cache
from operator import attrgetter
from typing import Any, ClassVar

import numpy as np

from us_sim.standalone.interfaces import Field, interface

__all__ = ["ARRAY_TYPES", "Message", "message_class"]

# Primitive: (array.array type code, NumPy dtype) of the sequences and arrays that rosidl packs.
ARRAY_TYPES: dict[str, tuple[str, Any]] = {
    "float32": ("f", np.float32),
    "float64": ("d", np.float64),
    "int8": ("b", np.int8),
    "uint8": ("B", np.uint8),
    "int16": ("h", np.int16),
    "uint16": ("H", np.uint16),
    "int32": ("i", np.int32),
    "uint32": ("I", np.uint32),
    "int64": ("q", np.int64),
    "uint64": ("Q", np.uint64),
}

_INTEGERS = {
    **{f"int{bits}": (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) for bits in (8, 16, 32, 64)},
    **{f"uint{bits}": (0, 2**bits - 1) for bits in (8, 16, 32, 64)},
}
_FLOAT_LIMITS = {"float32": 3.402823466e38, "float64": 1.7976931348623157e308}
_ZEROS: dict[str, Any] = {"bool": False, "byte": b"\x00", "string": ""}

Setter = Callable[[Any, Any], None]


class Message:
    """Base of all message classes; not part of rosidl, and not to be instantiated."""

    __slots__ = ()
    __msgtype__: ClassVar[str]
    _fields_and_field_types: ClassVar[dict[str, str]]
    _setters: ClassVar[dict[str, Setter]]
    _defaults: ClassVar[tuple[tuple[str, Setter, Any, bool], ...]]

    def __init__(self, **kwargs: Any) -> None:
        setters = self._setters
        for name, store, default, is_factory in self._defaults:
            if name in kwargs:
                setters[name](self, kwargs.pop(name))
            else:
                store(self, default() if is_factory else default)
        if kwargs:
            unknown = ", ".join(sorted(kwargs))
            raise AssertionError(f"Invalid arguments passed to constructor: {unknown}")

    @classmethod
    def get_fields_and_field_types(cls) -> dict[str, str]:
        """Names of the fields and their types as rosidl writes them."""
        return dict(cls._fields_and_field_types)

    def __repr__(self) -> str:
        arguments = []
        for name in self._fields_and_field_types:
            value = getattr(self, name)
            text = repr(value)
            if isinstance(value, array):
                text = text[len("array('X', ") : -1] if value else "[]"
            arguments.append(f"{name}={text}")
        return f"{type(self).__module__}.{type(self).__name__}({', '.join(arguments)})"

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, type(self)):
            return False
        for name in self._fields_and_field_types:
            mine, theirs = getattr(self, name), getattr(other, name)
            same = np.array_equal(mine, theirs) if isinstance(mine, np.ndarray) else mine == theirs
            if not same:
                return False
        return True

    __hash__ = None  # type: ignore[assignment]


@cache
def message_class(name: str) -> type[Message]:
    """The class of the message ``name``, for example ``sensor_msgs/msg/Image``.

    Raises:
        InterfaceError: Jazzy has no such message.
    """
    definition = interface(name)
    package, folder, short_name = name.split("/")
    namespace: dict[str, Any] = {
        "__slots__": tuple(f"_{field.name}" for field in definition.fields),
        "__module__": f"{package}.{folder}",
        "__doc__": f"Message class '{short_name}'.",
        "__msgtype__": name,
        "_fields_and_field_types": {field.name: field.idl_type for field in definition.fields},
        **definition.constants,
        **{
            f"{field.name.upper()}__DEFAULT": field.default
            for field in definition.fields
            if field.default is not None
        },
    }
    cls: Any = type(short_name, (Message,), namespace)
    cls._setters = {}
    defaults = []
    for field in definition.fields:
        store = getattr(cls, f"_{field.name}").__set__
        setter = _setter(field, store)
        documentation = f"Message field '{field.name}'."
        setattr(
            cls, field.name, property(attrgetter(f"_{field.name}"), setter, None, documentation)
        )
        cls._setters[field.name] = setter
        defaults.append((field.name, store, *_default(field)))
    cls._defaults = tuple(defaults)
    return cls


def _default(field: Field) -> tuple[Any, bool]:
    """The default of a field, and whether it is a function to be called for each message."""
    if field.default is not None:
        return field.default, False
    if field.shape == "sequence":
        if field.kind in ARRAY_TYPES:
            code = ARRAY_TYPES[field.kind][0]
            return (lambda: array(code)), True
        return list, True
    if field.shape == "array":
        size = field.size
        if field.kind in ARRAY_TYPES:
            dtype = ARRAY_TYPES[field.kind][1]
            return (lambda: np.zeros(size, dtype)), True
        if field.is_message:
            element = message_class(field.kind)
            return (lambda: [element() for _ in range(size)]), True
        zero = _ZEROS[field.kind]
        return (lambda: [zero] * size), True
    if field.is_message:
        return message_class(field.kind), True
    if field.kind in _FLOAT_LIMITS:
        return 0.0, False
    return _ZEROS.get(field.kind, 0), False


def _setter(field: Field, store: Setter) -> Setter:
    if field.shape == "scalar":
        check = _element_check(field)

        def set_scalar(message: Any, value: Any) -> None:
            check(value)
            store(message, value)

        return set_scalar
    if field.kind in ARRAY_TYPES:
        return (_packed_sequence if field.shape == "sequence" else _packed_array)(field, store)
    return _list_setter(field, store)


def _element_check(field: Field) -> Callable[[Any], None]:
    """A function that raises AssertionError, in rosidl's words, for what is no such element."""
    name = field.name
    if field.is_message:
        expected = message_class(field.kind)
        return _instance_check(
            expected, f"The '{name}' field must be a sub message of type '{expected.__name__}'"
        )
    if field.kind == "string":
        if not field.string_bound:
            return _instance_check(str, f"The '{name}' field must be of type 'str'")
        bound = field.string_bound

        def check_bounded(value: Any) -> None:
            if not isinstance(value, str) or len(value) > bound:
                raise AssertionError(
                    f"The '{name}' field must be string value not longer than {bound}"
                )

        return check_bounded
    if field.kind == "bool":
        return _instance_check(bool, f"The '{name}' field must be of type 'bool'")
    if field.kind == "byte":

        def check_byte(value: Any) -> None:
            if not isinstance(value, (bytes, bytearray)) or len(value) != 1:
                raise AssertionError(
                    f"The '{name}' field must be of type 'bytes' or 'ByteString' with length 1"
                )

        return check_byte
    if field.kind in _FLOAT_LIMITS:
        limit = _FLOAT_LIMITS[field.kind]
        idl_type = "float" if field.kind == "float32" else "double"

        def check_float(value: Any) -> None:
            if not isinstance(value, float):
                raise AssertionError(f"The '{name}' field must be of type 'float'")
            if not -limit <= value <= limit and math.isfinite(value):
                raise AssertionError(
                    f"The '{name}' field must be a {idl_type} in [{-limit}, {limit}]"
                )

        return check_float
    low, high = _INTEGERS[field.kind]

    def check_integer(value: Any) -> None:
        if not isinstance(value, int):
            raise AssertionError(f"The '{name}' field must be of type 'int'")
        if not low <= value <= high:
            sign = "an integer" if low else "an unsigned integer"
            raise AssertionError(f"The '{name}' field must be {sign} in [{low}, {high}]")

    return check_integer


def _instance_check(expected: type, sentence: str) -> Callable[[Any], None]:
    def check(value: Any) -> None:
        if not isinstance(value, expected):
            raise AssertionError(sentence)

    return check


def _packed_sequence(field: Field, store: Setter) -> Setter:
    """A setter that stores an array.array, the very one it is given where the type code fits."""
    name, bound = field.name, field.size
    code, dtype = ARRAY_TYPES[field.kind]
    element_check = _element_check(field)

    def convert(value: Any) -> array[Any]:
        if isinstance(value, array):
            raise AssertionError(f"The '{name}' array.array() must have the type code of '{code}'")
        if isinstance(value, np.ndarray):
            if value.dtype != dtype or value.ndim != 1:
                raise AssertionError(
                    f"The '{name}' field must be a one-dimensional ndarray of {dtype.__name__}, "
                    f"not of {value.dtype} with shape {value.shape}"
                )
            return array(code, value.tobytes())
        if isinstance(value, (bytes, bytearray, memoryview)) and code == "B":
            return array(code, bytes(value))
        _check_collection(field, value)
        for element in value:
            element_check(element)
        return array(code, value)

    def set_sequence(message: Any, value: Any) -> None:
        if not (type(value) is array and value.typecode == code):
            value = convert(value)
        if bound and len(value) > bound:
            raise AssertionError(f"The '{name}' array.array() must have a size <= {bound}")
        store(message, value)

    return set_sequence


def _packed_array(field: Field, store: Setter) -> Setter:
    """A setter that stores a NumPy array of the field's type and size."""
    name, size = field.name, field.size
    dtype = ARRAY_TYPES[field.kind][1]
    element_check = _element_check(field)

    def set_array(message: Any, value: Any) -> None:
        if isinstance(value, np.ndarray):
            if value.dtype != dtype:
                raise AssertionError(
                    f"The '{name}' numpy.ndarray() must have the dtype of 'numpy.{dtype.__name__}'"
                )
            if value.shape != (size,):
                raise AssertionError(f"The '{name}' numpy.ndarray() must have a size of {size}")
        else:
            _check_collection(field, value)
            for element in value:
                element_check(element)
            value = np.array(list(value), dtype)
        store(message, value)

    return set_array


def _list_setter(field: Field, store: Setter) -> Setter:
    """A setter for lists of strings, booleans, bytes and messages."""
    element_check = _element_check(field)

    def set_list(message: Any, value: Any) -> None:
        _check_collection(field, value)
        for element in value:
            element_check(element)
        store(message, value)

    return set_list


def _check_collection(field: Field, value: Any) -> None:
    if isinstance(value, str) or not hasattr(value, "__len__") or not hasattr(value, "__iter__"):
        raise AssertionError(f"The '{field.name}' field must be a set or sequence")
    length = len(value)
    if field.shape == "array" and length != field.size:
        raise AssertionError(
            f"The '{field.name}' field must be a set or sequence with length {field.size}"
        )
    if field.shape == "sequence" and field.size and length > field.size:
        raise AssertionError(
            f"The '{field.name}' field must be a set or sequence with length <= {field.size}"
        )
