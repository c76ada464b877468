"""Assigning to a message's fields, checked in rosidl's words."""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable
from typing import Any

import numpy as np

from .interfaces import Field

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

Setter = Callable[[Any, Any], None]
Check = Callable[[Any], None]


def field_setter(field: Field, store: Setter, message_class: type | None) -> Setter:
    """A function (message, value) that checks the value and stores it.

    Args:
        store: stores without checking; the slot's own setter.
        message_class: the class of the elements, where they are messages.
    """
    check = _element_check(field, message_class)
    if field.shape == "scalar":

        def set_scalar(message: Any, value: Any) -> None:
            check(value)
            store(message, value)

        return set_scalar
    if field.kind not in ARRAY_TYPES:
        return _list_setter(field, store, check)
    if field.shape == "sequence":
        return _packed_sequence_setter(field, store, check)
    return _packed_array_setter(field, store, check)


def _element_check(field: Field, message_class: type | None) -> Check:
    """A function that raises AssertionError, in rosidl's words, for what is no such element."""
    name = field.name
    if message_class is not None:
        sentence = f"The '{name}' field must be a sub message of type '{message_class.__name__}'"
        return _instance_check(message_class, sentence)
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


def _instance_check(expected: type, sentence: str) -> Check:
    def check(value: Any) -> None:
        if not isinstance(value, expected):
            raise AssertionError(sentence)

    return check


def _packed_sequence_setter(field: Field, store: Setter, check: Check) -> Setter:
    """A setter that stores an array.array, the very one it is given where the type code fits."""
    name, bound = field.name, field.size
    code, dtype = ARRAY_TYPES[field.kind]

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
        _check_collection(field, value, check)
        return array(code, value)

    def set_sequence(message: Any, value: Any) -> None:
        if not (type(value) is array and value.typecode == code):
            value = convert(value)
        if bound and len(value) > bound:
            raise AssertionError(f"The '{name}' array.array() must have a size <= {bound}")
        store(message, value)

    return set_sequence


def _packed_array_setter(field: Field, store: Setter, check: Check) -> Setter:
    """A setter that stores a NumPy array of the field's type and size."""
    name, size = field.name, field.size
    dtype = ARRAY_TYPES[field.kind][1]

    def set_array(message: Any, value: Any) -> None:
        if isinstance(value, np.ndarray):
            if value.dtype != dtype:
                raise AssertionError(
                    f"The '{name}' numpy.ndarray() must have the dtype of 'numpy.{dtype.__name__}'"
                )
            if value.shape != (size,):
                raise AssertionError(f"The '{name}' numpy.ndarray() must have a size of {size}")
        else:
            _check_collection(field, value, check)
            value = np.array(list(value), dtype)
        store(message, value)

    return set_array


def _list_setter(field: Field, store: Setter, check: Check) -> Setter:
    """A setter for lists of strings, booleans, bytes and messages."""

    def set_list(message: Any, value: Any) -> None:
        _check_collection(field, value, check)
        store(message, value)

    return set_list


def _check_collection(field: Field, value: Any, check: Check) -> None:
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
    for element in value:
        check(element)
