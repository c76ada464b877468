"""Message and service classes that behave like those rosidl generates, and their modules.

Assignments are checked as rosidl does with ``ROS_PYTHON_CHECK_FIELDS=1``: a value that a real node
would publish as garbage, or crash on, raises an AssertionError here.
"""

from __future__ import annotations

import importlib.util
import math
import sys
from array import array
from collections.abc import Callable
from functools import cache, partial
from operator import attrgetter
from types import ModuleType
from typing import Any, ClassVar

import numpy as np

from .interfaces import (
    IDL_NAMES,
    Field,
    InterfaceError,
    interface,
    message_names,
    packages,
    service_names,
)

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

_FLOAT_LIMITS = {"float32": 3.402823466e38, "float64": 1.7976931348623157e308}

Setter = Callable[[Any, Any], None]  # of a message and a value
Rule = tuple[Callable[[Any], bool], str]  # for a value, and rosidl's words for one that breaks it


def _field_setter(field: Field, store: Setter, message_class: type | None) -> Setter:
    """A function that checks a value and stores it, with an AssertionError in rosidl's words.

    Args:
        store: stores without checking; the slot's own setter.
        message_class: the class of the elements, where they are messages.
    """
    check = partial(_check, field.name, _element_rules(field, message_class))
    if field.shape == "scalar":
        convert = check
    elif field.kind not in ARRAY_TYPES:
        convert = partial(_checked_collection, field, check)
    elif field.shape == "sequence":
        convert = partial(_packed_sequence, field, *ARRAY_TYPES[field.kind], check)
    else:
        convert = partial(_packed_array, field, ARRAY_TYPES[field.kind][1], check)
    return lambda message, value: store(message, convert(value))


def _element_rules(field: Field, message_class: type | None) -> list[Rule]:
    kind, bound = field.kind, field.string_bound
    if message_class is not None:
        words = f"be a sub message of type '{message_class.__name__}'"
        return [(lambda value: isinstance(value, message_class), words)]
    if kind == "string" and bound:
        words = f"be string value not longer than {bound}"
        return [(lambda value: isinstance(value, str) and len(value) <= bound, words)]
    if kind == "string":
        return [(lambda value: isinstance(value, str), "be of type 'str'")]
    if kind == "bool":
        return [(lambda value: isinstance(value, bool), "be of type 'bool'")]
    if kind == "byte":
        words = "be of type 'bytes' or 'ByteString' with length 1"
        return [(lambda value: isinstance(value, bytes | bytearray) and len(value) == 1, words)]
    if kind in _FLOAT_LIMITS:
        limit = _FLOAT_LIMITS[kind]
        words = f"be a {IDL_NAMES[kind]} in [{-limit}, {limit}]"
        return [
            (lambda value: isinstance(value, float), "be of type 'float'"),
            (lambda value: -limit <= value <= limit or not math.isfinite(value), words),
        ]
    bits = int(kind.lstrip("uint"))
    low, high = (0, 2**bits - 1) if kind[0] == "u" else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    words = f"be {'an integer' if low else 'an unsigned integer'} in [{low}, {high}]"
    return [
        (lambda value: isinstance(value, int), "be of type 'int'"),
        (lambda value: low <= value <= high, words),
    ]


def _check(name: str, rules: list[Rule], value: Any) -> Any:
    for holds, words in rules:
        if not holds(value):
            raise AssertionError(f"The '{name}' field must {words}")
    return value


def _checked_collection(field: Field, check: Callable[[Any], Any], value: Any) -> Any:
    words = "be a set or sequence"
    if isinstance(value, str) or not hasattr(value, "__len__") or not hasattr(value, "__iter__"):
        raise AssertionError(f"The '{field.name}' field must {words}")
    if field.shape == "array" and len(value) != field.size:
        raise AssertionError(f"The '{field.name}' field must {words} with length {field.size}")
    if field.shape == "sequence" and field.size and len(value) > field.size:
        raise AssertionError(f"The '{field.name}' field must {words} with length <= {field.size}")
    for element in value:
        check(element)
    return value


def _packed_sequence(
    field: Field, code: str, dtype: Any, check: Callable[[Any], Any], value: Any
) -> array[Any]:
    """The value as an array.array: the very one that was given, where its type code fits."""
    name, bound = field.name, field.size
    if isinstance(value, array):
        if value.typecode != code:
            raise AssertionError(f"The '{name}' array.array() must have the type code of '{code}'")
    elif isinstance(value, np.ndarray):
        if value.dtype != dtype or value.ndim != 1:
            raise AssertionError(
                f"The '{name}' field must be a one-dimensional ndarray of {dtype.__name__}, "
                f"not of {value.dtype} with shape {value.shape}"
            )
        value = array(code, value.tobytes())
    elif isinstance(value, bytes | bytearray | memoryview) and code == "B":
        value = array(code, bytes(value))
    else:
        value = array(code, _checked_collection(field, check, value))
    if bound and len(value) > bound:
        raise AssertionError(f"The '{name}' array.array() must have a size <= {bound}")
    return value


def _packed_array(field: Field, dtype: Any, check: Callable[[Any], Any], value: Any) -> Any:
    name, size = field.name, field.size
    if not isinstance(value, np.ndarray):
        return np.array(list(_checked_collection(field, check, value)), dtype)
    if value.dtype != dtype:
        raise AssertionError(
            f"The '{name}' numpy.ndarray() must have the dtype of 'numpy.{dtype.__name__}'"
        )
    if value.shape != (size,):
        raise AssertionError(f"The '{name}' numpy.ndarray() must have a size of {size}")
    return value


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
        setter = _field_setter(field, store, element_class)
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


class Service:
    """Base of service classes, which carry the classes of their request and response."""

    __msgtype__: ClassVar[str]
    Request: ClassVar[type[Message]]
    Response: ClassVar[type[Message]]

    def __init__(self) -> None:
        raise TypeError("Service classes can not be instantiated")


@cache
def service_class(name: str) -> type[Service]:
    """The class of the service ``name``, for example ``std_srvs/srv/Trigger``.

    Raises:
        InterfaceError: there is no such service.
    """
    package, _, short_name = name.rpartition("/srv/")
    if short_name not in service_names(package):
        raise InterfaceError(
            f"there is no service {name!r} without ROS 2; there are rcl_interfaces' and std_srvs'"
        )
    return type(
        short_name,
        (Service,),
        {
            "__module__": f"{package}.srv",
            "__msgtype__": name,
            "Request": message_class(f"{name}_Request"),
            "Response": message_class(f"{name}_Response"),
        },
    )


def register_message_modules() -> None:
    """Make ``geometry_msgs.msg`` and the like importable, where no real package has that name.

    Classes are built when they are first asked for.
    """
    for package in packages():
        if package in sys.modules or importlib.util.find_spec(package) is not None:
            continue
        parent = ModuleType(package, f"Messages of {package}, provided by {__package__}.")
        parent.__path__ = []
        sys.modules[package] = parent
        for folder, names in (("msg", message_names(package)), ("srv", service_names(package))):
            if names:
                module = _InterfaceModule(package, folder, names)
                sys.modules[module.__name__] = module
                setattr(parent, folder, module)


class _InterfaceModule(ModuleType):
    """A module whose attributes are built on first use."""

    def __init__(self, package: str, folder: str, names: list[str]) -> None:
        super().__init__(f"{package}.{folder}", f"Interfaces of {package}.")
        self.__all__ = names
        self._build = message_class if folder == "msg" else service_class

    def __getattr__(self, name: str) -> Any:
        prefix = self.__name__.replace(".", "/")
        if name in self.__all__:
            cls: Any = self._build(f"{prefix}/{name}")
        elif name.endswith(("_Request", "_Response")) and (name.rpartition("_")[0] in self.__all__):
            cls = message_class(f"{prefix}/{name}")
        else:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        setattr(self, name, cls)
        return cls

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self.__all__]
