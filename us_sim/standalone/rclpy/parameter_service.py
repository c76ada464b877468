"""The six services by which others read, describe and set a node's parameters."""

import weakref
from typing import Any

from ..messages import message_class, service_class
from .exceptions import ParameterNotDeclaredException, ParameterUninitializedException
from .parameter import Parameter
from .qos import qos_profile_parameters


class ParameterService:
    """Offers `<node>/get_parameters` and the five others."""

    def __init__(self, node: Any):
        self._node = weakref.ref(node)
        for name, callback in {
            "DescribeParameters": self._describe_parameters,
            "GetParameters": self._get_parameters,
            "GetParameterTypes": self._get_parameter_types,
            "ListParameters": self._list_parameters,
            "SetParameters": self._set_parameters,
            "SetParametersAtomically": self._set_parameters_atomically,
        }.items():
            node.create_service(
                service_class(f"rcl_interfaces/srv/{name}"),
                f"{node.get_name()}/{_snake_case(name)}",
                callback,
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


def _snake_case(name: str) -> str:
    return "".join(f"_{letter.lower()}" if letter.isupper() else letter for letter in name)[1:]
