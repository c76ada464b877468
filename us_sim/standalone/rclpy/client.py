"""Clients of services: made by `Node.create_client`."""

import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from ..messages import serialize
from ..services import ServiceClient
from ._endpoints import NodeLink, Receiver, message_of
from ._rclpy_pybind11 import RCLError
from .callback_groups import CallbackGroup
from .context import Context
from .qos import QoSProfile
from .task import Future

_PAUSE = 0.01  # s, between two looks at whether a service is there


class Client(Receiver):
    """Sends requests to one service."""

    service_name = Receiver._existing_name

    def __init__(
        self,
        link: NodeLink,
        srv_type: Any,
        srv_name: str,
        full_name: str,
        qos_profile: QoSProfile,
        callback_group: CallbackGroup,
    ) -> None:
        endpoint = ServiceClient(
            link.context._participant, full_name, srv_type.__msgtype__, qos_profile
        )
        super().__init__(link, full_name, endpoint, qos_profile, callback_group)
        self.context = link.context
        self.srv_type = srv_type
        self.srv_name = srv_name
        self._pending_requests: dict[int, Future] = {}
        self._lock = threading.Lock()

    def call(self, request: Any, timeout_sec: float | None = None) -> Any:
        """Send a request and wait for the response, while an executor spins in another thread."""
        answered = threading.Event()
        future = self.call_async(request)
        future.add_done_callback(lambda _: answered.set())
        if not future.done() and not answered.wait(timeout_sec):
            self.remove_pending_request(future)
        error = future.exception()
        if error is not None:
            raise error
        return future.result()

    def call_async(self, request: Any) -> Future:
        """Send a request; the future of its response."""
        if not isinstance(request, self.srv_type.Request):
            raise TypeError(f"Expected {self.srv_type.Request}, got {type(request)}")
        self._require_existence()
        if not self.context.ok():
            raise RCLError("failed to send request: the client's context is invalid")
        future = Future()
        with self._lock:  # held over sending: the response may come before this returns
            sequence_number = self._endpoint.send_request(serialize(request))
            self._pending_requests[sequence_number] = future
        future.add_done_callback(self.remove_pending_request)
        return future

    def get_pending_request(self, sequence_number: int) -> Future:
        """The future of a request that was sent; raises KeyError when there is none."""
        with self._lock:
            return self._pending_requests[sequence_number]

    def remove_pending_request(self, future: Future) -> None:
        """Expect no response for this future any more."""
        with self._lock:
            for sequence_number, pending in self._pending_requests.items():
                if pending is future:
                    del self._pending_requests[sequence_number]
                    break

    def service_is_ready(self) -> bool:
        """Whether a service is connected."""
        self._require_existence()
        return self._endpoint.service_is_ready()

    def wait_for_service(self, timeout_sec: float | None = None) -> bool:
        """Wait until a service is connected; whether it was within the time."""
        return wait_until(self.service_is_ready, self.context, timeout_sec)

    def _call_for(self, data: bytes, info: Any) -> Callable[[], Any] | None:
        response = message_of(data, self.srv_type.Response)
        try:
            future = self.get_pending_request(info.sequence)
        except KeyError:
            return None  # nobody waits for it any more
        return partial(future._set_result_in_executor, response)


def wait_until(condition: Callable[[], bool], context: Context, timeout_sec: float | None) -> bool:
    """Wait while the context is up; whether the condition came true within the time."""
    deadline = None if timeout_sec is None else time.monotonic() + timeout_sec
    while context.ok() and not condition():
        if deadline is not None and time.monotonic() >= deadline:
            break
        time.sleep(_PAUSE)
    return condition()
