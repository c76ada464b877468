"""What can happen to an endpoint, and what a callback is told about it."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from .qos import QoSPolicyKind

__all__ = [
    "REPORTS",
    "QoSLivelinessChangedInfo",
    "QoSLivelinessLostInfo",
    "QoSMessageLostInfo",
    "QoSOfferedDeadlineMissedInfo",
    "QoSOfferedIncompatibleQoSInfo",
    "QoSPublisherEventType",
    "QoSPublisherMatchedInfo",
    "QoSRequestedDeadlineMissedInfo",
    "QoSRequestedIncompatibleQoSInfo",
    "QoSSubscriptionEventType",
    "QoSSubscriptionMatchedInfo",
]


class QoSPublisherEventType(IntEnum):
    """What can happen to a publisher."""

    RCL_PUBLISHER_OFFERED_DEADLINE_MISSED = 0
    RCL_PUBLISHER_LIVELINESS_LOST = 1
    RCL_PUBLISHER_OFFERED_INCOMPATIBLE_QOS = 2
    RCL_PUBLISHER_INCOMPATIBLE_TYPE = 3
    RCL_PUBLISHER_MATCHED = 4


class QoSSubscriptionEventType(IntEnum):
    """What can happen to a subscription."""

    RCL_SUBSCRIPTION_REQUESTED_DEADLINE_MISSED = 0
    RCL_SUBSCRIPTION_LIVELINESS_CHANGED = 1
    RCL_SUBSCRIPTION_REQUESTED_INCOMPATIBLE_QOS = 2
    RCL_SUBSCRIPTION_MESSAGE_LOST = 3
    RCL_SUBSCRIPTION_INCOMPATIBLE_TYPE = 4
    RCL_SUBSCRIPTION_MATCHED = 5


@dataclass(frozen=True)
class QoSRequestedDeadlineMissedInfo:
    """How often no message came, or none was published, within the deadline."""

    total_count: int
    total_count_change: int


QoSOfferedDeadlineMissedInfo = QoSRequestedDeadlineMissedInfo


@dataclass(frozen=True)
class QoSLivelinessLostInfo:
    """How often a publisher did not say in time that it is alive."""

    total_count: int
    total_count_change: int


@dataclass(frozen=True)
class QoSLivelinessChangedInfo:
    """How many of a subscription's publishers are alive, and how many are not any more."""

    alive_count: int
    not_alive_count: int
    alive_count_change: int
    not_alive_count_change: int


@dataclass(frozen=True)
class QoSMessageLostInfo:
    """How many messages were lost on their way."""

    total_count: int
    total_count_change: int


@dataclass(frozen=True)
class QoSRequestedIncompatibleQoSInfo:
    """How many endpoints were met whose quality does not fit, and by which policy."""

    total_count: int
    total_count_change: int
    last_policy_kind: QoSPolicyKind


QoSOfferedIncompatibleQoSInfo = QoSRequestedIncompatibleQoSInfo


@dataclass(frozen=True)
class QoSSubscriptionMatchedInfo:
    """How many endpoints match now, and how many ever did."""

    total_count: int
    total_count_change: int
    current_count: int
    current_count_change: int


QoSPublisherMatchedInfo = QoSSubscriptionMatchedInfo

_Event = QoSPublisherEventType | QoSSubscriptionEventType

# What the transport calls an event, and what a callback gets for it.
REPORTS: dict[_Event, tuple[str, Callable[[Any], Any]]] = {
    event_type: (kind, report)
    for kind, report, event_types in (
        (
            "deadline",
            lambda e: QoSRequestedDeadlineMissedInfo(e.total_count, e.total_count_change),
            (
                QoSPublisherEventType.RCL_PUBLISHER_OFFERED_DEADLINE_MISSED,
                QoSSubscriptionEventType.RCL_SUBSCRIPTION_REQUESTED_DEADLINE_MISSED,
            ),
        ),
        (
            "incompatible_qos",
            lambda e: QoSRequestedIncompatibleQoSInfo(
                e.total_count, e.total_count_change, QoSPolicyKind[e.policy]
            ),
            (
                QoSPublisherEventType.RCL_PUBLISHER_OFFERED_INCOMPATIBLE_QOS,
                QoSSubscriptionEventType.RCL_SUBSCRIPTION_REQUESTED_INCOMPATIBLE_QOS,
            ),
        ),
        (
            "matched",
            lambda e: QoSSubscriptionMatchedInfo(
                e.total_count, e.total_count_change, e.current_count, e.current_count_change
            ),
            (
                QoSPublisherEventType.RCL_PUBLISHER_MATCHED,
                QoSSubscriptionEventType.RCL_SUBSCRIPTION_MATCHED,
            ),
        ),
        (
            "message_lost",
            lambda e: QoSMessageLostInfo(e.total_count, e.total_count_change),
            (QoSSubscriptionEventType.RCL_SUBSCRIPTION_MESSAGE_LOST,),
        ),
        (
            "liveliness",
            lambda e: QoSLivelinessLostInfo(e.total_count, e.total_count_change),
            (QoSPublisherEventType.RCL_PUBLISHER_LIVELINESS_LOST,),
        ),
        (
            "liveliness",
            lambda e: QoSLivelinessChangedInfo(
                e.current_count,
                e.not_alive_count,
                e.current_count_change,
                e.not_alive_count_change,
            ),
            (QoSSubscriptionEventType.RCL_SUBSCRIPTION_LIVELINESS_CHANGED,),
        ),
    )
    for event_type in event_types
}
