"""The parameters of another node."""

from collections.abc import Callable, Sequence
from typing import Any

from ..messages import service_class
from .callback_groups import CallbackGroup
from .client import wait_until
from .node import Node
from .parameter import Parameter
from .qos import QoSProfile, qos_profile_services_default
from .task import Future

Callback = Callable[[Future], Any]


class AsyncParameterClient:
    """Asks another node's parameter services; every answer is a future of the response.

    Each request takes an optional `callback`, which is called with the future when it is done.
    """

    def __init__(
        self,
        node: Node,
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
            for service, type_name in (
                ("get_parameters", "GetParameters"),
                ("list_parameters", "ListParameters"),
                ("set_parameters", "SetParameters"),
                ("get_parameter_types", "GetParameterTypes"),
                ("describe_parameters", "DescribeParameters"),
                ("set_parameters_atomically", "SetParametersAtomically"),
            )
        }

    def services_are_ready(self) -> bool:
        """Whether all six services are connected."""
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
        """Ask for names: those that begin with one of the prefixes, of a depth."""
        return self._call("list_parameters", callback, prefixes=prefixes or [], depth=depth or 0)

    def get_parameters(self, names: list[str], callback: Callback | None = None) -> Future:
        """Ask for values."""
        return self._call("get_parameters", callback, names=names)

    def set_parameters(self, parameters: Sequence[Any], callback: Callback | None = None) -> Future:
        """Set Parameters or `rcl_interfaces/msg/Parameter`s one by one."""
        return self._call("set_parameters", callback, parameters=_messages(parameters))

    def describe_parameters(self, names: list[str], callback: Callback | None = None) -> Future:
        """Ask for descriptors."""
        return self._call("describe_parameters", callback, names=names)

    def get_parameter_types(self, names: list[str], callback: Callback | None = None) -> Future:
        """Ask for types."""
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
