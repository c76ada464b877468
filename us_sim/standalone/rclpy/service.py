"""Services: made by `Node.create_service`."""

from collections.abc import Callable
from functools import partial
from typing import Any

from ..messages import serialize
from ..services import RequestHeader, ServiceServer
from ._endpoints import NodeLink, Receiver, message_of
from ._rclpy_pybind11 import RCLError
from .callback_groups import CallbackGroup
from .logging import get_logger
from .qos import QoSProfile


class Service(Receiver):
    """Calls back with each request, and answers with what the callback returns."""

    service_name = Receiver._existing_name

    def __init__(
        self,
        link: NodeLink,
        srv_type: Any,
        srv_name: str,
        full_name: str,
        callback: Callable[..., Any],
        callback_group: CallbackGroup,
        qos_profile: QoSProfile,
    ) -> None:
        endpoint = ServiceServer(
            link.context._participant, full_name, srv_type.__msgtype__, qos_profile
        )
        super().__init__(link, full_name, endpoint, qos_profile, callback_group)
        self.srv_type = srv_type
        self.srv_name = srv_name
        self.callback = callback

    def send_response(self, response: Any, header: Any) -> None:
        """Answer a request, given the header that came with it."""
        if not isinstance(response, self.srv_type.Response):
            raise TypeError(f"Expected {self.srv_type.Response}, got {type(response)}")
        if not isinstance(header, RequestHeader):
            raise TypeError(f"Expected the header of a request, got {type(header)}")
        self._require_existence()
        if self._context.ok():
            self._endpoint.send_response(serialize(response), header)

    def _call_for(self, data: bytes, info: Any) -> Callable[[], Any] | None:
        try:
            request = message_of(data, self.srv_type.Request)
        except RCLError as error:
            get_logger("rclpy").warning(
                f"a request for {self._full_name} is not answered: {error}; a client on Fast DDS "
                f"cannot call a service on Cyclone DDS: set RMW_IMPLEMENTATION=rmw_cyclonedds_cpp "
                f"there",
                throttle_duration_sec=5.0,
            )
            return None
        return partial(self._answer, request, info)

    def _answer(self, request: Any, header: RequestHeader) -> None:
        self.send_response(self.callback(request, self.srv_type.Response()), header)
