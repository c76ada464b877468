"""Services: made by `Node.create_service`."""

from collections.abc import Callable
from typing import Any

from ._rclpy_pybind11 import rmw_request_id_t, rmw_service_info_t
from .callback_groups import CallbackGroup
from .qos import QoSProfile

__all__ = ["Service"]


class Service:
    """Calls back with each request, and answers with what the callback returns."""

    def __init__(
        self,
        service_impl: Any,
        srv_type: Any,
        srv_name: str,
        callback: Callable[..., Any],
        callback_group: CallbackGroup,
        qos_profile: QoSProfile,
    ) -> None:
        self._service = service_impl
        self.srv_type = srv_type
        self.srv_name = srv_name
        self.callback = callback
        self.callback_group = callback_group
        self._executor_event = False
        self.qos_profile = qos_profile

    def send_response(self, response: Any, header: Any) -> None:
        """Answer a request, given the header that came with it.

        Raises:
            TypeError: the response is of another type, or the header is none.
        """
        if not isinstance(response, self.srv_type.Response):
            raise TypeError(f"Expected {self.srv_type.Response}, got {type(response)}")
        if isinstance(header, rmw_service_info_t):
            header = header.request_id
        if not isinstance(header, rmw_request_id_t):
            raise TypeError(f"Expected the header of a request, got {type(header)}")
        self._service.service_send_response(response, header)

    @property
    def handle(self) -> Any:
        return self._service

    @property
    def service_name(self) -> str:
        return self._service.name

    def destroy(self) -> None:
        """Offer the service no more; use `Node.destroy_service`."""
        self._service.destroy()
