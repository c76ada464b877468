"""Parameters: a name, a type and a value; their services, and a client of another node's."""

import array
import math
import operator
import weakref
from collections.abc import Callable, Sequence
from enum import Enum
from functools import partial
from operator import attrgetter
from typing import Any

from ..messages import message_class, service_class
from .endpoints import CallbackGroup, wait_until
from .exceptions import ParameterNotDeclaredException, ParameterUninitializedException
from .qos import QoSProfile, qos_profile_parameters, qos_profile_services_default
from .task import Future

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
        type_ = Parameter.Type(param_msg.value.type)
        return cls(param_msg.name, type_, getattr(param_msg.value, _field(type_), None))

    def get_parameter_value(self):
        message: Any = message_class("rcl_interfaces/msg/ParameterValue")(type=self._type.value)
        if self._value is not None:
            setattr(message, _field(self._type), self._value)
        return message

    def to_parameter_msg(self):
        cls = message_class("rcl_interfaces/msg/Parameter")
        return cls(name=self._name, value=self.get_parameter_value())

    def __repr__(self) -> str:
        return f"Parameter({self._name!r}, {self._type}, {self._value!r})"


def _field(type_: Parameter.Type) -> str:
    """The field of a `rcl_interfaces/msg/ParameterValue` that holds a value of a type."""
    return f"{type_.name.lower()}_value"


def reason_against(parameter: Parameter, descriptor: Any, tolerance: float) -> str:
    """The reason why a value is outside its descriptor's range or between its steps, or "".

    Args:
        parameter: the value to be set.
        descriptor: a `rcl_interfaces/msg/ParameterDescriptor`.
        tolerance: relative, for comparing floating-point numbers.
    """
    is_integer = parameter.type_ is Parameter.Type.INTEGER
    if is_integer and descriptor.integer_range:
        limits, same, dot, fault = descriptor.integer_range[0], operator.eq, ".", "is not a"
    elif parameter.type_ is Parameter.Type.DOUBLE and descriptor.floating_point_range:
        limits, same = descriptor.floating_point_range[0], partial(math.isclose, rel_tol=tolerance)
        dot, fault = "", "is not close enough to a"
    else:
        return ""
    name, value, step = parameter.name, parameter.value, limits.step
    least, most = sorted((limits.from_value, limits.to_value))
    if same(value, least) or same(value, most):
        return ""
    if not least < value < most:
        return f"Parameter {name} out of range{dot} Min: {least}, Max: {most}, value: {value}"
    if step:
        steps = (value - least) // step if is_integer else round((value - least) / step)
        if not same(least + steps * step, value):
            return (
                f"The parameter value for {name} {fault} valid step. "
                f"Min: {least}, max: {most}, value: {value}, step: {step}"
            )
    return ""


_SERVICES = {
    "describe_parameters": "DescribeParameters",
    "get_parameters": "GetParameters",
    "get_parameter_types": "GetParameterTypes",
    "list_parameters": "ListParameters",
    "set_parameters": "SetParameters",
    "set_parameters_atomically": "SetParametersAtomically",
}


class ParameterService:
    """Offers `<node>/get_parameters` and the five others."""

    def __init__(self, node: Any):
        self._node = weakref.ref(node)
        for service, type_name in _SERVICES.items():
            node.create_service(
                service_class(f"rcl_interfaces/srv/{type_name}"),
                f"{node.get_name()}/{service}",
                getattr(self, f"_{service}"),
                qos_profile=qos_profile_parameters,
            )

    # A request with an unknown name is answered by an empty list, as rclpy does.

    def _describe_parameters(self, request: Any, response: Any) -> Any:
        node = self._require_node()
        try:
            response.descriptors = [node.describe_parameter(name) for name in request.names]
        except ParameterNotDeclaredException:
            response.descriptors = []
        return response

    def _get_parameters(self, request: Any, response: Any) -> Any:
        node = self._require_node()
        try:
            response.values = [
                node.get_parameter(name).get_parameter_value() for name in request.names
            ]
        except (ParameterNotDeclaredException, ParameterUninitializedException):
            response.values = []
        return response

    def _get_parameter_types(self, request: Any, response: Any) -> Any:
        node = self._require_node()
        try:
            for name in request.names:
                type_ = node.get_parameter_type(name)
                response.types.append(type_.value if isinstance(type_, Parameter.Type) else type_)
        except ParameterNotDeclaredException:
            del response.types[:]
        return response

    def _list_parameters(self, request: Any, response: Any) -> Any:
        response.result = self._require_node().list_parameters(
            list(request.prefixes), request.depth
        )
        return response

    def _set_parameters(self, request: Any, response: Any) -> Any:
        node = self._require_node()
        response.results = [_set_atomically(node, [parameter]) for parameter in request.parameters]
        return response

    def _set_parameters_atomically(self, request: Any, response: Any) -> Any:
        response.result = _set_atomically(self._require_node(), request.parameters)
        return response

    def _require_node(self) -> Any:
        node = self._node()
        if node is None:
            raise ReferenceError("Expected valid node weak reference")
        return node


def _set_atomically(node: Any, messages: list[Any]) -> Any:
    try:
        parameters = [Parameter.from_parameter_msg(message) for message in messages]
        return node.set_parameters_atomically(parameters)
    # The others: a parameter of a type that there is not.
    except (ParameterNotDeclaredException, ValueError, TypeError) as error:
        return message_class("rcl_interfaces/msg/SetParametersResult")(
            successful=False, reason=str(error)
        )


Callback = Callable[[Future], Any]


class AsyncParameterClient:
    """Asks another node's parameter services; every answer is a future of the response.

    Each request takes an optional `callback`, which is called with the future when it is done.
    """

    def __init__(
        self,
        node: Any,
        remote_node_name: str,
        qos_profile: QoSProfile = qos_profile_services_default,
        callback_group: CallbackGroup | None = None,
    ):
        self.remote_node_name = remote_node_name
        self.node = node
        self._clients = {
            service: node.create_client(
                service_class(f"rcl_interfaces/srv/{type_name}"),
                f"{remote_node_name}/{service}",
                qos_profile=qos_profile,
                callback_group=callback_group,
            )
            for service, type_name in _SERVICES.items()
        }

    def services_are_ready(self) -> bool:
        return all(client.service_is_ready() for client in self._clients.values())

    def wait_for_services(self, timeout_sec: float | None = None) -> bool:
        """Wait until all six services are connected; whether they were within the time."""
        return wait_until(self.services_are_ready, self.node.context, timeout_sec)

    def list_parameters(
        self,
        prefixes: list[str] | None = None,
        depth: int | None = None,
        callback: Callback | None = None,
    ) -> Future:
        return self._call("list_parameters", callback, prefixes=prefixes or [], depth=depth or 0)

    def get_parameters(self, names: list[str], callback: Callback | None = None) -> Future:
        return self._call("get_parameters", callback, names=names)

    def set_parameters(self, parameters: Sequence[Any], callback: Callback | None = None) -> Future:
        """Set Parameters or `rcl_interfaces/msg/Parameter`s one by one."""
        return self._call("set_parameters", callback, parameters=_messages(parameters))

    def describe_parameters(self, names: list[str], callback: Callback | None = None) -> Future:
        return self._call("describe_parameters", callback, names=names)

    def get_parameter_types(self, names: list[str], callback: Callback | None = None) -> Future:
        return self._call("get_parameter_types", callback, names=names)

    def set_parameters_atomically(
        self, parameters: Sequence[Any], callback: Callback | None = None
    ) -> Future:
        """Set all Parameters or `rcl_interfaces/msg/Parameter`s, or none."""
        return self._call("set_parameters_atomically", callback, parameters=_messages(parameters))

    def _call(self, service: str, callback: Callback | None, **fields: Any) -> Future:
        client = self._clients[service]
        future = client.call_async(client.srv_type.Request(**fields))
        if callback is not None:
            future.add_done_callback(callback)
        return future


def _messages(parameters: Sequence[Any]) -> list[Any]:
    return [
        parameter.to_parameter_msg() if isinstance(parameter, Parameter) else parameter
        for parameter in parameters
    ]
