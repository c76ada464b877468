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

from array import array
from functools import cache
from operator import attrgetter
from typing import Any, ClassVar

import numpy as np

from .field_setters import ARRAY_TYPES, Setter, field_setter
from .interfaces import Field, interface

_ZEROS: dict[str, Any] = {"bool": False, "byte": b"\x00", "string": ""}


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
        element_class = message_class(field.kind) if field.is_message else None
        setter = field_setter(field, store, element_class)
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
    if field.kind in ("float32", "float64"):
        return 0.0, False
    return _ZEROS.get(field.kind, 0), False
