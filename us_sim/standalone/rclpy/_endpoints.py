"""What stands behind publishers and subscriptions: DDS writers and readers.

Readers say from the transport's thread that data may be waiting; executors take it in their own.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ..messages import CdrError, deserialize, serialize, type_hash
from ..transport import DdsError, EndpointEvent
from ._context_handle import ContextHandle
from ._rclpy_pybind11 import InvalidHandle, RCLError
from .duration import Duration
from .qos import QoSProfile

__all__ = [
    "Endpoint",
    "Inbox",
    "NodeLink",
    "PublisherHandle",
    "SubscriptionHandle",
    "message_of",
]

Listener = Callable[[EndpointEvent], None]


@dataclass(frozen=True)
class NodeLink:
    """What an endpoint needs of its node, without keeping the node alive."""

    context: ContextHandle
    logger_name: str
    wake: Callable[[], None]


class Endpoint:
    """Common to publishers, subscriptions, clients and services: it exists until `destroy`."""

    def __init__(self, link: NodeLink, name: str) -> None:
        self.logger_name = link.logger_name
        self._context = link.context
        self._wake = link.wake
        self._name = name
        self._destroyed = False

    def _require_existence(self) -> None:
        if self._destroyed:
            raise InvalidHandle("cannot use Destroyable because destruction was requested")


class _TopicEndpoint(Endpoint):
    """A reader or a writer of a topic, and who listens to what happens to it."""

    _endpoint: Any

    def __init__(self, link: NodeLink, topic: str) -> None:
        super().__init__(link, topic)
        self._listeners: dict[str, Listener] = {}

    @property
    def gid(self) -> bytes:
        """16 bytes that no other endpoint has."""
        return self._endpoint.gid

    def get_topic_name(self) -> str:
        """The absolute name of the topic."""
        self._require_existence()
        return self._name

    def add_event_listener(self, kind: str, listener: Listener) -> None:
        """Have a kind of event reported, from the transport's thread, once `listen` was called."""
        self._listeners[kind] = listener

    def listen(self) -> None:
        """Report events from now on, those before included."""
        if self._listeners:
            self._endpoint.on_event = self._dispatch

    def remove_event_listener(self, kind: str) -> None:
        """The counterpart of `add_event_listener`."""
        self._listeners.pop(kind, None)

    def _dispatch(self, event: EndpointEvent) -> None:
        listener = self._listeners.get(event.kind)
        if listener is not None:
            listener(event)
            self._wake()

    def destroy(self) -> None:
        """Leave the topic."""
        if not self._destroyed:
            self._destroyed = True
            self._endpoint.close()


class PublisherHandle(_TopicEndpoint):
    """Writes messages to a topic."""

    def __init__(self, link: NodeLink, msg_type: Any, topic: str, qos: QoSProfile) -> None:
        super().__init__(link, topic)
        self._endpoint = link.context.participant.create_writer(*_topic(topic, msg_type, qos))
        self._write = self._endpoint.write

    def publish(self, msg: Any) -> bool:
        """Send a message; False when a subscription was too slow to accept it."""
        return self.publish_raw(serialize(msg))

    def publish_raw(self, data: bytes) -> bool:
        """Send a serialized message; False when a subscription was too slow to accept it."""
        self._require_existence()
        if not self._context.ok():
            raise RCLError("Failed to publish: publisher's context is invalid")
        try:
            return self._write(data)
        except DdsError as error:
            raise RCLError(f"Failed to publish: {error}") from None

    def get_subscription_count(self) -> int:
        """How many subscriptions are connected."""
        self._require_existence()
        return self._endpoint.matched_count()

    def assert_liveliness(self) -> None:
        """Say that this publisher is alive."""
        self._require_existence()
        self._endpoint.assert_liveliness()

    def wait_for_all_acked(self, timeout: Duration) -> bool:
        """Whether everything was received within a time; a negative one never ends."""
        self._require_existence()
        return self._endpoint.wait_for_acked(timeout.nanoseconds / 1e9)


class Inbox:
    """Serialized data that may be waiting: `ready` says whether to look, `fetch` looks.

    What was fetched is kept until it is taken, so that an executor can be sure before it commits.
    """

    def __init__(self, take: Callable[[], Any], wake: Callable[[], None]) -> None:
        self.ready = False
        self.wake = wake
        self._take = take
        self._fetched: Any = None

    def notify(self) -> None:
        """Data may have come; called from the transport's thread."""
        self.ready = True
        self.wake()

    def fetch(self) -> bool:
        """Whether there is something to take."""
        if self._fetched is None:
            self.ready = False  # before looking, so that what comes meanwhile is noticed
            self._fetched = self._take()
            self.ready = self.ready or self._fetched is not None
        return self._fetched is not None

    def take(self) -> Any:
        """What was fetched, or is waiting now; None when there is nothing."""
        self.fetch()
        fetched, self._fetched = self._fetched, None
        return fetched


class SubscriptionHandle(_TopicEndpoint):
    """Reads messages from a topic."""

    def __init__(self, link: NodeLink, msg_type: Any, topic: str, qos: QoSProfile) -> None:
        super().__init__(link, topic)
        self._endpoint = link.context.participant.create_reader(*_topic(topic, msg_type, qos))
        self.inbox = Inbox(self._endpoint.take, self._wake)
        self._endpoint.on_data = self.inbox.notify

    def take_message(self, msg_type: Any, raw: bool) -> tuple[Any, dict[str, Any]] | None:
        """The oldest message that is waiting (as bytes if raw) and where it came from."""
        self._require_existence()
        taken = self.inbox.take()
        if taken is None:
            return None
        data, info = taken
        return data if raw else message_of(data, msg_type), {
            "source_timestamp": info.source_timestamp,
            "received_timestamp": info.received_timestamp,
            "publication_sequence_number": None,
            "reception_sequence_number": None,
        }

    def get_publisher_count(self) -> int:
        """How many publishers are connected."""
        self._require_existence()
        return self._endpoint.matched_count()


def message_of(data: bytes, cls: Any) -> Any:
    """The message that was received; raises RCLError when the bytes are none of the class."""
    try:
        return deserialize(data, cls)
    except CdrError as error:
        raise RCLError(f"failed to take message: {error}") from None


def _topic(topic: str, msg_type: Any, qos: QoSProfile) -> tuple[str, str, QoSProfile, str]:
    """DDS topic, DDS type, quality and user data of an endpoint."""
    package, folder, name = msg_type.__msgtype__.split("/")
    dds_topic = topic[1:] if qos.avoid_ros_namespace_conventions else f"rt{topic}"
    dds_type = f"{package}::{folder}::dds_::{name}_"
    return dds_topic, dds_type, qos, f"typehash={type_hash(msg_type.__msgtype__)};"
