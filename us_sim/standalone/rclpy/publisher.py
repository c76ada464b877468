"""Publishers: made by `Node.create_publisher`."""

from typing import Any

from ..messages import serialize
from ..transport import DdsError
from ._endpoints import Connected, NodeLink, open_endpoint
from ._rclpy_pybind11 import RCLError
from .logging import get_logger
from .qos import QoSProfile


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
        except DdsError as error:
            raise RCLError(f"Failed to publish: {error}") from None
        if not accepted:
            self._logger.warning(
                f"A message on '{self.topic}' was dropped: a reliable subscription "
                "takes messages too slowly.",
                throttle_duration_sec=5.0,
            )

    def get_subscription_count(self) -> int:
        """How many subscriptions are connected."""
        self._require_existence()
        return self._endpoint.matched_count()
