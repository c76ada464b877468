"""What executors do with one entity: take its data and call its callback."""

import threading
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from .client import Client
from .exceptions import InvalidHandle
from .guard_condition import GuardCondition
from .service import Service
from .subscription import Subscription
from .timer import Timer
from .waitable import Waitable

if TYPE_CHECKING:
    from .executors import Executor

__all__ = ["WorkTracker", "take_call"]


class WorkTracker:
    """Which threads run callbacks now."""

    def __init__(self) -> None:
        self._threads: dict[int, int] = {}
        self._changed = threading.Condition()

    def begin(self) -> None:
        """This thread runs a callback."""
        me = threading.get_ident()
        with self._changed:
            self._threads[me] = self._threads.get(me, 0) + 1

    def end(self) -> None:
        """This thread has run a callback."""
        me = threading.get_ident()
        with self._changed:
            left = self._threads.get(me, 0) - 1
            if left > 0:
                self._threads[me] = left
            else:
                self._threads.pop(me, None)
            self._changed.notify_all()

    def wait(self, timeout_sec: float | None) -> bool:
        """Wait until no other thread runs a callback; False when it takes longer."""
        me = threading.get_ident()
        if timeout_sec is not None and timeout_sec < 0:
            timeout_sec = None
        with self._changed:
            return self._changed.wait_for(lambda: not self._threads.keys() - {me}, timeout_sec)


def take_call(entity: Any, executor: "Executor") -> Callable[[], Any] | None:
    """Take what is waiting for an entity; returns the call that is to be made, if any.

    The call returns an awaitable when the entity's callback is a coroutine.
    """
    try:
        return _TAKERS[_kind(entity)](entity, executor)
    except InvalidHandle:  # it was destroyed meanwhile
        return None


def _kind(entity: Any) -> type:
    return next(kind for kind in _TAKERS if isinstance(entity, kind))


def _take_subscription(subscription: Any, _: "Executor") -> Callable[[], Any] | None:
    taken = subscription._subscription.take_message(subscription.msg_type, subscription.raw)
    if taken is None:
        return None
    if subscription._callback_type is Subscription.CallbackType.MessageOnly:
        return partial(subscription.callback, taken[0])
    return partial(subscription.callback, *taken)


def _take_timer(timer: Any, _: "Executor") -> Callable[[], Any] | None:
    if timer._canceled:
        return None
    timer._advance()
    return timer.callback


def _take_guard(guard: Any, _: "Executor") -> Callable[[], Any] | None:
    guard._triggered = False
    return guard.callback


def _take_client(client: Any, executor: "Executor") -> Callable[[], Any] | None:
    info, response = client._client.take_response(client.srv_type.Response)
    if info is None:
        return None

    def settle() -> None:
        try:
            future = client.get_pending_request(info.request_id.sequence_number)
        except KeyError:
            return  # nobody waits for it any more
        future._set_executor(executor)
        future.set_result(response)

    return settle


def _take_service(service: Any, _: "Executor") -> Callable[[], Any] | None:
    request, info = service._service.service_take_request(service.srv_type.Request)
    if info is None:
        return None

    def answer() -> Any:
        response = service.callback(request, service.srv_type.Response())
        if hasattr(response, "__await__"):
            return answer_later(response)
        service.send_response(response, info)
        return None

    async def answer_later(coming: Any) -> None:
        service.send_response(await coming, info)

    return answer


def _take_waitable(waitable: Any, executor: "Executor") -> Callable[[], Any] | None:
    data = waitable.take_data()
    for future in waitable._futures:
        future._set_executor(executor)
    return partial(waitable.execute, data)


_TAKERS: dict[type, Callable[..., Callable[[], Any] | None]] = {
    Subscription: _take_subscription,
    Timer: _take_timer,
    GuardCondition: _take_guard,
    Client: _take_client,
    Service: _take_service,
    Waitable: _take_waitable,
}
