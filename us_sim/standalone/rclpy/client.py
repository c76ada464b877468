"""Clients of services: made by `Node.create_client`."""

import threading
import time
from typing import Any

from .callback_groups import CallbackGroup
from .context import Context
from .qos import QoSProfile
from .task import Future

__all__ = ["Client"]

_LONGEST_WAIT = 0.25  # s; the graph's changes wake it earlier


class Client:
    """Sends requests to one service."""

    def __init__(
        self,
        context: Context,
        client_impl: Any,
        srv_type: Any,
        srv_name: str,
        qos_profile: QoSProfile,
        callback_group: CallbackGroup,
    ) -> None:
        self.context = context
        self._client = client_impl
        self.srv_type = srv_type
        self.srv_name = srv_name
        self.qos_profile = qos_profile
        self.callback_group = callback_group
        self._pending_requests: dict[int, Future] = {}
        self._executor_event = False
        self._lock = threading.Lock()

    def call(self, request: Any, timeout_sec: float | None = None) -> Any:
        """Send a request and wait for the response, while an executor spins in another thread.

        Returns:
            The response; None when it did not come in time.

        Raises:
            TypeError: the request is of another type.
        """
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
        """Send a request.

        Returns:
            The future of the response.

        Raises:
            TypeError: the request is of another type.
        """
        if not isinstance(request, self.srv_type.Request):
            raise TypeError(f"Expected {self.srv_type.Request}, got {type(request)}")
        future = Future()
        with self._lock:  # held over sending: the response may come before this returns
            sequence_number = self._client.send_request(request)
            if sequence_number in self._pending_requests:
                raise RuntimeError(f"Sequence ({sequence_number}) conflicts with pending request")
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
        return self._client.service_server_is_available()

    def wait_for_service(self, timeout_sec: float | None = None) -> bool:
        """Wait until a service is connected; whether it was within the time."""
        deadline = None if timeout_sec is None else time.monotonic() + timeout_sec
        graph_changed = self.context.handle.graph_changed  # type: ignore[union-attr]
        while self.context.ok() and not self.service_is_ready():
            rest = _LONGEST_WAIT if deadline is None else deadline - time.monotonic()
            if rest <= 0:
                break
            with graph_changed:
                graph_changed.wait(min(rest, _LONGEST_WAIT))
        return self.service_is_ready()

    @property
    def handle(self) -> Any:
        return self._client

    @property
    def service_name(self) -> str:
        return self._client.service_name

    def destroy(self) -> None:
        """Leave the service; use `Node.destroy_client`."""
        self._client.destroy()
