"""Which entities of a node are ready, and how long to wait when none is."""

import time
from collections.abc import Callable, Generator, Iterable
from typing import TYPE_CHECKING, Any

from .constants import S_TO_NS

if TYPE_CHECKING:
    from .node import Node

__all__ = ["ready_entities", "time_to_wait"]

Predicate = Callable[[Any], bool]


def ready_entities(node: "Node", can_execute: Predicate) -> Generator[Any, None, None]:
    """The entities whose callbacks may start, each looked at when its turn comes.

    They come in rclpy's order; subscriptions, clients and services only if data is there for sure.
    """
    for waitable in list(node._waitables):
        if waitable.is_ready(None) and can_execute(waitable):
            yield waitable
    for timer in list(node._timers):
        if timer._is_due() and can_execute(timer):
            yield timer
    for subscription in list(node._subscriptions):
        inbox = subscription._subscription.inbox
        if inbox.ready and can_execute(subscription) and inbox.fetch():
            yield subscription
    for guard in list(node._guards):
        if guard._triggered and can_execute(guard):
            yield guard
    for client in list(node._clients):
        inbox = client._client.inbox
        if inbox.ready and can_execute(client) and inbox.fetch():
            yield client
    for service in list(node._services):
        inbox = service._service.inbox
        if inbox.ready and can_execute(service) and inbox.fetch():
            yield service


def time_to_wait(
    nodes: "Iterable[Node]", can_execute: Predicate, deadline: float | None
) -> float | None:
    """Seconds until a timer is due or the deadline comes; 0 when something may be ready.

    None stands for ever: only a message, a trigger or the like will end that.
    """
    rest = None if deadline is None else deadline - time.monotonic()
    for node in nodes:
        if any(can_execute(entity) for entity in _stirred(node)):
            return 0.0
        for timer in list(node._timers):
            if timer._canceled or not can_execute(timer):
                continue
            if timer._is_due():
                return 0.0
            if timer._clock._runs_by_itself():
                until_due = (timer._next_call - timer._clock._now()) / S_TO_NS
                rest = until_due if rest is None else min(rest, until_due)
    return rest


def _stirred(node: "Node") -> Generator[Any, None, None]:
    """The entities, except timers, that are or may be ready."""
    for waitable in list(node._waitables):
        if waitable.is_ready(None):
            yield waitable
    for subscription in list(node._subscriptions):
        if subscription._subscription.inbox.ready:
            yield subscription
    for guard in list(node._guards):
        if guard._triggered:
            yield guard
    for client in list(node._clients):
        if client._client.inbox.ready:
            yield client
    for service in list(node._services):
        if service._service.inbox.ready:
            yield service
