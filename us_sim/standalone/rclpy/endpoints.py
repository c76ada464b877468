"""Publishers and all that executors call back: subscriptions, clients, services, timers, guards.

Nodes make them. The middleware tells from a thread of its own that data may be waiting; executors
take it in their own.
"""

import inspect
import threading
import time
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from functools import partial
from operator import attrgetter
from threading import Lock
from typing import Any

from ..cdr import CdrError, deserialize, serialize
from ..middleware import MiddlewareError, Owner, RequestHeader
from .context import Context, get_default_context
from .exceptions import Destroyable, NoTypeSupportImportedException, RCLError
from .logging import get_logger
from .qos import QoSProfile
from .task import Future
from .time import Clock


class CallbackGroup:
    """Subscriptions, timers, services, … whose callbacks are scheduled together."""

    def __init__(self) -> None:
        self.entities: set[weakref.ReferenceType[Any]] = set()

    def add_entity(self, entity: Any) -> None:
        self.entities.add(weakref.ref(entity, self.entities.discard))

    def has_entity(self, entity: Any) -> bool:
        return weakref.ref(entity) in self.entities

    def can_execute(self, entity: Any) -> bool:  # noqa: ARG002
        raise RuntimeError(
            f"{type(self).__name__} does not say when callbacks may run; use "
            "MutuallyExclusiveCallbackGroup or ReentrantCallbackGroup"
        )

    def beginning_execution(self, entity: Any) -> bool:
        """Reserve the group for an entity's callback; False when it may not start."""
        return self.can_execute(entity)

    def ending_execution(self, entity: Any) -> None:
        """Give the group back after an entity's callback."""


class ReentrantCallbackGroup(CallbackGroup):
    """Callbacks that may run at the same time as each other."""

    def can_execute(self, entity: Any) -> bool:  # noqa: ARG002
        return True


class MutuallyExclusiveCallbackGroup(CallbackGroup):
    """Callbacks of which only one runs at a time."""

    def __init__(self):
        super().__init__()
        self._active_entity = None
        self._lock = Lock()

    def can_execute(self, entity: Any) -> bool:
        assert weakref.ref(entity) in self.entities
        return self._active_entity is None

    def beginning_execution(self, entity: Any) -> bool:
        with self._lock:
            assert weakref.ref(entity) in self.entities
            if self._active_entity is None:
                self._active_entity = entity
                return True
        return False

    def ending_execution(self, entity: Any) -> None:
        with self._lock:
            assert self._active_entity is entity
            self._active_entity = None


class GuardCondition(Destroyable):
    """Triggered any number of times before the executor looks, it calls back once."""

    _executor_event = False

    def __init__(
        self,
        callback: Callable[..., Any] | None,
        callback_group: CallbackGroup | None,
        context: Context | None = None,
    ):
        context = get_default_context() if context is None else context
        context._require_init("guard condition")
        self._context = context
        self._triggered = False
        self.callback = callback
        self.callback_group = callback_group

    def trigger(self) -> None:
        """Have the callback called soon; raises InvalidHandle after `destroy`."""
        self._require_existence()
        self._triggered = True
        self._context._wake_all()

    def destroy(self) -> None:
        """Forget that it was triggered, and be triggered no more."""
        super().destroy()
        self._triggered = False

    def _may_be_ready(self) -> bool:
        return self._triggered

    _fetch = _may_be_ready

    def _take(self) -> Callable[..., Any] | None:
        self._triggered = False
        return self.callback


class Timer(Destroyable):
    """Calls back each period. Periods that were missed are skipped, not caught up with."""

    _executor_event = False
    clock = property(attrgetter("_clock"))

    def __init__(
        self,
        callback: Callable[..., Any] | None,
        callback_group: CallbackGroup | None,
        timer_period_ns: int,
        clock: Clock,
        *,
        context: Context | None = None,
        autostart: bool = True,
    ):
        context = get_default_context() if context is None else context
        context._require_init("timer")
        if timer_period_ns < 0:
            raise RCLError("failed to create timer: timer period must be non-negative")
        self._context = context
        self._clock = clock
        self._period = int(timer_period_ns)
        self._last_call = clock._now()
        self._next_call = self._last_call + self._period
        self._canceled = not autostart
        self.callback = callback
        self.callback_group = callback_group
        clock._timers.add(self)

    @property
    def timer_period_ns(self) -> int:
        self._require_existence()
        return self._period

    @timer_period_ns.setter
    def timer_period_ns(self, value: int) -> None:
        self._require_existence()
        if int(value) < 0:
            raise RCLError("failed to exchange timer period: period must be non-negative")
        self._period = int(value)

    def is_ready(self) -> bool:
        self._require_existence()
        return self._may_be_ready()

    def is_canceled(self) -> bool:
        self._require_existence()
        return self._canceled

    def cancel(self) -> None:
        self._require_existence()
        self._canceled = True

    def reset(self) -> None:
        """Start the timer, the next call being one period from now."""
        self._require_existence()
        self._next_call = self._clock._now() + self._period
        self._canceled = False
        self._context._wake_all()

    def time_since_last_call(self) -> int:
        self._require_existence()
        return self._clock._now() - self._last_call

    def time_until_next_call(self) -> int | None:
        """Nanoseconds until the callback is due, negative when it is late, None when stopped."""
        self._require_existence()
        return None if self._canceled else self._next_call - self._clock._now()

    def destroy(self) -> None:
        super().destroy()
        self._canceled = True
        self._clock._timers.discard(self)

    def _may_be_ready(self) -> bool:
        return not self._canceled and self._next_call <= self._clock._now()

    def _fetch(self) -> bool:
        return True

    def _real_time_left(self) -> int | None:
        """Nanoseconds of real time until it is due; None when real time does not bring that."""
        if self._canceled or not self._clock._runs_by_itself():
            return None
        return self._next_call - self._clock._now()

    def _take(self) -> Callable[..., Any] | None:
        if self._canceled:
            return None
        now = self._last_call = self._clock._now()
        if not self._period:
            self._next_call = max(self._next_call, now)
        else:  # the first period that is still to come
            periods = max(1, 1 + (now - self._next_call) // self._period)
            self._next_call += periods * self._period
        return self.callback

    def _on_time_jump(self, before: int, is_other_time: bool) -> None:
        """Keep the rest of the period when another kind of time begins; restart it when time
        goes back by more than a period."""
        now = self._clock._now()
        if is_other_time:
            self._last_call += now - before
            self._next_call += now - before
        elif now < self._last_call:
            self._last_call = now
            self._next_call = now + self._period
        self._context._wake_all()


def serialize_message(message: Any) -> bytes:
    require_message_class(type(message))
    return serialize(message)


def deserialize_message(serialized_message: bytes, message_type: Any) -> Any:
    require_message_class(message_type)
    return deserialize(serialized_message, message_type)


def require_message_class(cls: Any) -> None:
    """Raise NoTypeSupportImportedException for anything but a class of messages."""
    if not isinstance(cls, type) or not hasattr(cls, "__msgtype__") or hasattr(cls, "Request"):
        raise NoTypeSupportImportedException()


@dataclass(frozen=True)
class NodeLink:
    """A node's context, name, logger name and wake-up, without keeping the node alive."""

    context: Context
    owner: Owner
    logger_name: str
    wake: Callable[[], None]


def open_endpoint(
    kind: str, link: NodeLink, msg_type: Any, topic: str, full_name: str, qos: QoSProfile
) -> Any:
    """The middleware's endpoint for a "publisher" or a "subscription".

    Args:
        topic: the topic's name as the node wrote it.
        full_name: its absolute name.

    Raises:
        NoTypeSupportImportedException: the class is none of messages.
        RCLError: the quality of service is refused.
    """
    require_message_class(msg_type)
    middleware = link.context._middleware
    if kind == "publisher":
        create: Any = middleware.create_publisher
        other = "subscription"
        effect = "requesting incompatible QoS. No messages will be sent to it"
    else:
        create = middleware.create_subscription
        other = "publisher"
        effect = "offering incompatible QoS. No messages will be received from it"
    logger = get_logger(link.logger_name)
    try:
        return create(
            link.owner,
            full_name,
            msg_type.__msgtype__,
            qos,
            lambda policy: logger.warning(
                f"New {other} discovered on topic '{topic}', {effect}. "
                f"Last incompatible policy: {policy}"
            ),
        )
    except MiddlewareError as error:
        raise RCLError(f"failed to create {kind}: {error}") from None


class Inbox:
    """Serialized data that may be waiting: `ready` says whether to look, `fetch` looks.

    What was fetched is kept until it is taken, so that an executor can be sure before it commits.
    """

    def __init__(self, take: Callable[[], Any], wake: Callable[[], None]) -> None:
        self.ready = False
        self._wake = wake
        self._take = take
        self._fetched: Any = None

    def notify(self) -> None:
        """Data may have come; called from the transport's thread."""
        self.ready = True
        self._wake()

    def fetch(self) -> bool:
        """Whether there is something to take."""
        if self._fetched is None:
            self.ready = False  # before looking, so that data that come meanwhile are noticed
            self._fetched = self._take()
            self.ready = self.ready or self._fetched is not None
        return self._fetched is not None

    def take(self) -> Any:
        """The data that were fetched or are waiting now; None when there are none."""
        self.fetch()
        fetched, self._fetched = self._fetched, None
        return fetched


class Connected(Destroyable):
    """An endpoint that is on the network under an absolute name until `destroy`."""

    def __init__(self, link: NodeLink, full_name: str, endpoint: Any, qos: QoSProfile) -> None:
        self._context = link.context
        self.qos_profile = qos
        self._full_name = full_name
        self._endpoint = endpoint
        self._gids: tuple[list[bytes], list[bytes]] = endpoint.gids  # of readers and writers

    def destroy(self) -> None:
        """Leave the network; use the node's own method for that."""
        super().destroy()
        self._endpoint.close()

    @property
    def _existing_name(self) -> str:
        self._require_existence()
        return self._full_name


class Receiver(Connected, ABC):
    """A subscription, client or service as executors see it: its inbox says when it is ready."""

    _executor_event = False

    def __init__(
        self, link: NodeLink, full_name: str, endpoint: Any, qos: QoSProfile, group: CallbackGroup
    ) -> None:
        super().__init__(link, full_name, endpoint, qos)
        self.callback_group = group
        self._inbox = Inbox(endpoint.take, link.wake)
        endpoint.set_on_data(self._inbox.notify)

    def _may_be_ready(self) -> bool:
        return self._inbox.ready

    def _fetch(self) -> bool:
        return self._inbox.fetch()

    def _take(self) -> Callable[[], Any] | None:
        """The call to be made for the oldest data that wait, None when there are none."""
        self._require_existence()
        taken = self._inbox.take()
        return None if taken is None else self._call_for(*taken)

    @abstractmethod
    def _call_for(self, data: bytes, info: Any) -> Callable[[], Any] | None:
        """The call to be made for serialized data that came from somewhere."""


def message_of(data: bytes, cls: Any) -> Any:
    """The message that was received; raises RCLError when the bytes are none of the class."""
    try:
        return deserialize(data, cls)
    except CdrError as error:
        raise RCLError(f"failed to take message: {error}") from None


class Publisher(Connected):
    """Sends messages of one type to one topic."""

    topic_name = Connected._existing_name

    def __init__(
        self, link: NodeLink, msg_type: Any, topic: str, full_name: str, qos_profile: QoSProfile
    ) -> None:
        writer = open_endpoint("publisher", link, msg_type, topic, full_name, qos_profile)
        super().__init__(link, full_name, writer, qos_profile)
        self._logger = get_logger(link.logger_name)
        self.msg_type = msg_type
        self.topic = topic

    def publish(self, msg: Any) -> None:
        """Send a message, or bytes that were serialized before."""
        if isinstance(msg, self.msg_type):
            msg = serialize(msg)
        elif not isinstance(msg, bytes):
            raise TypeError(f"Expected {self.msg_type}, got {type(msg)}")
        self._require_existence()
        if not self._context.ok():
            raise RCLError("Failed to publish: publisher's context is invalid")
        try:
            accepted = self._endpoint.write(msg)
        except MiddlewareError as error:
            raise RCLError(f"Failed to publish: {error}") from None
        if not accepted:
            self._logger.warning(
                f"A message on '{self.topic}' was dropped: a reliable subscription "
                "takes messages too slowly.",
                throttle_duration_sec=5.0,
            )

    def get_subscription_count(self) -> int:
        self._require_existence()
        return self._endpoint.matched_count()


class Subscription(Receiver):
    """Calls back with each message that is received on one topic."""

    topic_name = Receiver._existing_name

    class CallbackType(Enum):
        """Whether a callback takes the message only, or also where it came from."""

        MessageOnly = 0
        WithMessageInfo = 1

    def __init__(
        self,
        link: NodeLink,
        msg_type: Any,
        topic: str,
        full_name: str,
        callback: Callable[..., Any],
        callback_group: CallbackGroup,
        qos_profile: QoSProfile,
        raw: bool,
    ) -> None:
        self.callback = callback
        reader = open_endpoint("subscription", link, msg_type, topic, full_name, qos_profile)
        super().__init__(link, full_name, reader, qos_profile, callback_group)
        self.msg_type = msg_type
        self.topic = topic
        self.raw = raw

    def get_publisher_count(self) -> int:
        self._require_existence()
        return self._endpoint.matched_count()

    @property
    def callback(self) -> Callable[..., Any]:
        return self._callback

    @callback.setter
    def callback(self, value: Callable[..., Any]) -> None:
        for kind, arguments in (
            (Subscription.CallbackType.MessageOnly, (None,)),
            (Subscription.CallbackType.WithMessageInfo, (None, None)),
        ):
            try:
                inspect.signature(value).bind(*arguments)
            except TypeError:
                continue
            self._callback = value
            self._callback_type = kind
            return
        raise RuntimeError(
            "Subscription.__init__(): callback should be either be callable with one argument"
            "(to get only the message) or two (to get message and message info)"
        )

    def _call_for(self, data: bytes, info: Any) -> Callable[[], Any]:
        message = data if self.raw else message_of(data, self.msg_type)
        if self._callback_type is Subscription.CallbackType.MessageOnly:
            return partial(self.callback, message)
        origin = {
            "source_timestamp": info.source_timestamp,
            "received_timestamp": info.received_timestamp,
            "publication_sequence_number": info.sequence,
            "reception_sequence_number": None,
        }
        return partial(self.callback, message, origin)


_logger = get_logger("rclpy")
_PAUSE = 0.01  # s, between two checks whether a service is there


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
        endpoint = link.context._middleware.create_client(
            link.owner, full_name, srv_type.__msgtype__, qos_profile
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
        self._require_existence()
        return self._endpoint.service_is_ready()

    def wait_for_service(self, timeout_sec: float | None = None) -> bool:
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


class Service(Receiver):
    """Calls back with each request, and sends the returned response."""

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
        endpoint = link.context._middleware.create_service(
            link.owner, full_name, srv_type.__msgtype__, qos_profile
        )
        super().__init__(link, full_name, endpoint, qos_profile, callback_group)
        self.srv_type = srv_type
        self.srv_name = srv_name
        self.callback = callback
        endpoint.on_unanswered = lambda why: _logger.warning(
            f"a request for {full_name} is not answered, {why}; further requests of this kind are "
            f"ignored silently",
            once=True,
        )

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
            _logger.warning(
                f"a request for {self._full_name} is not answered: {error}",
                throttle_duration_sec=5.0,
            )
            return None
        return partial(self._answer, request, info)

    def _answer(self, request: Any, header: RequestHeader) -> None:
        self.send_response(self.callback(request, self.srv_type.Response()), header)
