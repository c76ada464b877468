"""Publishers: made by `Node.create_publisher`."""

from typing import Any

from .callback_groups import CallbackGroup
from .duration import Duration
from .event_handler import PublisherEventCallbacks
from .logging import get_logger
from .qos import QoSProfile

__all__ = ["Publisher"]


class Publisher:
    """Sends messages of one type to one topic."""

    def __init__(
        self,
        publisher_impl: Any,
        msg_type: Any,
        topic: str,
        qos_profile: QoSProfile,
        event_callbacks: PublisherEventCallbacks,
        callback_group: CallbackGroup,
    ) -> None:
        self._publisher = publisher_impl
        self._logger = get_logger(publisher_impl.logger_name)
        self.msg_type = msg_type
        self.topic = topic
        self.qos_profile = qos_profile
        self.event_handlers = event_callbacks.create_event_handlers(
            callback_group, publisher_impl, topic
        )

    def publish(self, msg: Any) -> None:
        """Send a message, or bytes that were serialized before.

        Raises:
            TypeError: the message is of another type.
            RCLError: the context was shut down.
        """
        if isinstance(msg, self.msg_type):
            accepted = self._publisher.publish(msg)
        elif isinstance(msg, bytes):
            accepted = self._publisher.publish_raw(msg)
        else:
            raise TypeError(f"Expected {self.msg_type}, got {type(msg)}")
        if not accepted:
            self._logger.warning(
                f"A message on '{self.topic}' was dropped: a reliable subscription "
                "takes messages too slowly.",
                throttle_duration_sec=5.0,
            )

    def get_subscription_count(self) -> int:
        """How many subscriptions are connected."""
        return self._publisher.get_subscription_count()

    @property
    def topic_name(self) -> str:
        return self._publisher.get_topic_name()

    @property
    def handle(self) -> Any:
        return self._publisher

    def destroy(self) -> None:
        """Leave the topic; use `Node.destroy_publisher`."""
        for handler in self.event_handlers:
            handler.destroy()
        self._publisher.destroy()

    def assert_liveliness(self) -> None:
        """Say that this publisher is alive, where its liveliness is MANUAL_BY_TOPIC."""
        self._publisher.assert_liveliness()

    def wait_for_all_acked(self, timeout: Duration = Duration(seconds=-1)) -> bool:  # noqa: B008
        """Wait until every reliable subscription has received everything.

        Returns:
            False when that did not happen within the timeout; a negative one never ends.
        """
        return self._publisher.wait_for_all_acked(timeout)
