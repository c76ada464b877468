"""Wait for one message, without an executor."""

import time
from typing import TYPE_CHECKING, Any

from ._endpoints import SubscriptionHandle
from ._node_topics import profile_of
from ._wake_up import WakeUp
from .qos import QoSProfile

if TYPE_CHECKING:
    from .node import Node

__all__ = ["wait_for_message"]


def wait_for_message(
    msg_type: Any,
    node: "Node",
    topic: str,
    *,
    qos_profile: QoSProfile | int = 1,
    time_to_wait: float = -1,
) -> tuple[bool, Any]:
    """Wait for the next message on a topic.

    Args:
        msg_type: class of the messages.
        node: whose names and context count; it need not spin.
        topic: relative, private (~/…) or absolute name.
        qos_profile: quality of service, or the depth of a reliable history.
        time_to_wait: seconds; a negative number for ever.

    Returns:
        True and the message; False and None when none came in time or the context was shut down.
    """
    waiting = WakeUp()
    handle = node._context_handle
    handle.register(waiting)
    subscription = SubscriptionHandle(
        node._link, msg_type, node.resolve_topic_name(topic), profile_of(qos_profile)
    )
    subscription.inbox.wake = waiting.wake
    deadline = None if time_to_wait < 0 else time.monotonic() + time_to_wait
    try:
        while handle.ok():
            taken = subscription.take_message(msg_type, False)
            if taken is not None:
                return True, taken[0]
            rest = None if deadline is None else deadline - time.monotonic()
            if rest is not None and rest <= 0:
                break
            waiting.wait(rest)
    finally:
        subscription.destroy()
    return False, None
