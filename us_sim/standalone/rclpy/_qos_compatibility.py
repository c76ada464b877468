"""Whether a publisher's and a subscription's profile can meet, by the rules of DDS.

A subscription must not ask for more than the publisher offers. Policies left to the middleware
make the answer a warning. The sentences are those of rmw_dds_common, since tools show them.
"""

from enum import IntEnum
from typing import TYPE_CHECKING

from .duration import Duration

if TYPE_CHECKING:
    from .qos import QoSPolicyEnum, QoSProfile

__all__ = ["QoSCompatibility", "qos_check_compatible"]

_UNSPECIFIED = Duration()


class QoSCompatibility(IntEnum):
    """The answer of `qos_check_compatible`."""

    OK = 0
    WARNING = 1
    ERROR = 2


def qos_check_compatible(
    publisher_qos: "QoSProfile", subscription_qos: "QoSProfile"
) -> tuple[QoSCompatibility, str]:
    """Check whether a publisher and a subscription with these profiles can communicate.

    Returns:
        The answer, and the reasons for a warning or an error ('' when there is none).
    """
    if errors := _contradictions(publisher_qos, subscription_qos):
        return QoSCompatibility.ERROR, "".join(f"ERROR: {error};" for error in errors)
    if doubts := _doubts(publisher_qos, subscription_qos):
        return QoSCompatibility.WARNING, "".join(f"WARNING: {doubt};" for doubt in doubts)
    return QoSCompatibility.OK, ""


def _contradictions(publisher: "QoSProfile", subscription: "QoSProfile") -> list[str]:
    found = []
    if (publisher.reliability.name, subscription.reliability.name) == ("BEST_EFFORT", "RELIABLE"):
        found.append("Best effort publisher and reliable subscription")
    if (publisher.durability.name, subscription.durability.name) == ("VOLATILE", "TRANSIENT_LOCAL"):
        found.append("Volatile publisher and transient local subscription")
    if subscription.deadline != _UNSPECIFIED:
        if publisher.deadline == _UNSPECIFIED:
            found.append("Subscription has a deadline, but publisher does not")
        elif subscription.deadline < publisher.deadline:
            found.append("Subscription deadline is less than publisher deadline")
    if (publisher.liveliness.name, subscription.liveliness.name) == (
        "AUTOMATIC",
        "MANUAL_BY_TOPIC",
    ):
        found.append("Publisher's liveliness is automatic and subscription's is manual by topic")
    lease = subscription.liveliness_lease_duration
    if lease != _UNSPECIFIED:
        if publisher.liveliness_lease_duration == _UNSPECIFIED:
            found.append("Subscription has a liveliness lease duration, but publisher does not")
        elif lease < publisher.liveliness_lease_duration:
            found.append("Subscription liveliness lease duration is less than publisher")
    return found


def _doubts(publisher: "QoSProfile", subscription: "QoSProfile") -> list[str]:
    found = []
    offered, asked = publisher.reliability, subscription.reliability
    if _open(offered) and _open(asked):
        found.append(
            f"Publisher reliability is {_word(offered)} and "
            f"subscription reliability is {_word(asked)}"
        )
    elif _open(offered) and asked.name == "RELIABLE":
        found.append(f"Reliable subscription, but publisher is {_word(offered)}")
    elif offered.name == "BEST_EFFORT" and _open(asked):
        found.append(f"Best effort publisher, but subscription is {_word(asked)}")

    offered, asked = publisher.durability, subscription.durability
    if _open(offered) and _open(asked):
        found.append(  # the misspelling is rmw_dds_common's
            f"Publisher durabilty is {_word(offered)} and subscription durability is {_word(asked)}"
        )
    elif _open(offered) and asked.name == "TRANSIENT_LOCAL":
        found.append(f"Transient local subscription, but publisher is {_word(offered)}")
    elif offered.name == "VOLATILE" and _open(asked):
        found.append(f"Volatile publisher, but subscription is {_word(asked)}")

    offered, asked = publisher.liveliness, subscription.liveliness
    if _open(offered) and _open(asked):
        found.append(
            f"Publisher liveliness is {_word(offered)} and "
            f"subscription liveliness is {_word(asked)}"
        )
    elif _open(offered) and asked.name == "MANUAL_BY_TOPIC":
        found.append(
            f"Subscription's liveliness is manual by topic, but publisher's is {_word(offered)}"
        )
    elif offered.name == "AUTOMATIC" and _open(asked):
        found.append(f"Publisher's liveliness is automatic, but subscription's is {_word(asked)}")
    return found


def _open(policy: "QoSPolicyEnum") -> bool:
    """Whether a policy is left to the middleware, so that nothing can be said about it."""
    return policy.name in ("SYSTEM_DEFAULT", "UNKNOWN")


def _word(policy: "QoSPolicyEnum") -> str:
    return "unknown" if policy.name == "UNKNOWN" else policy.name.lower()
