"""From rclpy's topics and services to DDS readers and writers.

Readers say from the transport's thread that data may be waiting; executors take it in their own.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ..messages import CdrError, deserialize, type_hash
from ..transport import DdsError, Participant
from ._rclpy_pybind11 import Destroyable, RCLError
from .callback_groups import CallbackGroup
from .context import Context
from .logging import get_logger
from .qos import QoSProfile
from .serialization import require_message_class

_KINDS: dict[
    str, tuple[Callable[..., Any], str]
] = {  # how the participant makes one, and what is said of one that does not fit
    "publisher": (
        Participant.create_writer,
        "New subscription discovered on topic '{}', requesting incompatible QoS. "
        "No messages will be sent to it. Last incompatible policy: {}",
    ),
    "subscription": (
        Participant.create_reader,
        "New publisher discovered on topic '{}', offering incompatible QoS. "
        "No messages will be received from it. Last incompatible policy: {}",
    ),
}


@dataclass(frozen=True)
class NodeLink:
    """What an endpoint needs of its node, without keeping the node alive."""

    context: Context
    logger_name: str
    wake: Callable[[], None]


def open_endpoint(
    kind: str, link: NodeLink, msg_type: Any, topic: str, full_name: str, qos: QoSProfile
) -> Any:
    """A DDS writer for a 'publisher', or reader for a 'subscription'.

    Args:
        topic: the topic's name as the node wrote it.
        full_name: its absolute name.

    Raises:
        NoTypeSupportImportedException: the class is none of messages.
        RCLError: the quality of service is refused.
    """
    require_message_class(msg_type)
    package, folder, name = msg_type.__msgtype__.split("/")
    create, refusal = _KINDS[kind]
    logger = get_logger(link.logger_name)
    try:
        return create(
            link.context._participant,
            full_name[1:] if qos.avoid_ros_namespace_conventions else f"rt{full_name}",
            f"{package}::{folder}::dds_::{name}_",
            qos,
            f"typehash={type_hash(msg_type.__msgtype__)};",
            on_incompatible=lambda policy: logger.warning(refusal.format(topic, policy)),
        )
    except DdsError as error:
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
            self.ready = False  # before looking, so that what comes meanwhile is noticed
            self._fetched = self._take()
            self.ready = self.ready or self._fetched is not None
        return self._fetched is not None

    def take(self) -> Any:
        """What was fetched, or is waiting now; None when there is nothing."""
        self.fetch()
        fetched, self._fetched = self._fetched, None
        return fetched


class Connected(Destroyable):
    """What is on the network under an absolute name until `destroy`."""

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

    def _stirred(self) -> bool:
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
