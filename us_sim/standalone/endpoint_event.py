"""What can happen to a reader or a writer besides data."""

from __future__ import annotations

import ctypes as ct
from collections.abc import Iterator
from dataclasses import dataclass

from us_sim.standalone.ddsc import lib

__all__ = ["EndpointEvent", "read_events", "status_mask"]

# The policies by DDS's numbers (dds_qos_policy_id), with the names that rclpy has for them.
_POLICIES = {
    2: "DURABILITY",
    4: "DEADLINE",
    8: "LIVELINESS",
    11: "RELIABILITY",
    13: "HISTORY",
    21: "LIFESPAN",
}


@dataclass(frozen=True)
class EndpointEvent:
    """A change of one of the statuses that DDS keeps of an endpoint.

    Attributes:
        kind: ``incompatible_qos``, ``deadline``, ``liveliness``, ``message_lost`` or ``matched``.
        total_count: how often it has happened.
        total_count_change: how often since the last event of this kind.
        current_count: endpoints that are matched, or writers that are alive (a reader's
            ``liveliness``).
        current_count_change: its change since the last event of this kind.
        not_alive_count, not_alive_count_change: writers that are not alive.
        policy: the policy that was last incompatible, by rclpy's name (``RELIABILITY``).
    """

    kind: str
    total_count: int = 0
    total_count_change: int = 0
    current_count: int = 0
    current_count_change: int = 0
    not_alive_count: int = 0
    not_alive_count_change: int = 0
    policy: str = "INVALID"


class _Status(ct.Structure):
    """Any of the status structures: up to four 32-bit numbers, some with 64 bits behind."""

    _fields_ = (("numbers", ct.c_int32 * 4), ("handle", ct.c_uint64))


# Status bit: (what it is, the C function's name), by what the other side is called.
_STATUSES: dict[str, dict[int, tuple[str, str]]] = {
    "subscription": {
        1 << 1: ("deadline", "offered_deadline_missed"),
        1 << 3: ("incompatible_qos", "offered_incompatible_qos"),
        1 << 9: ("liveliness", "liveliness_lost"),
        1 << 11: ("matched", "publication_matched"),
    },
    "publication": {
        1 << 2: ("deadline", "requested_deadline_missed"),
        1 << 4: ("incompatible_qos", "requested_incompatible_qos"),
        1 << 5: ("message_lost", "sample_lost"),
        1 << 10: ("liveliness", "liveliness_changed"),
        1 << 12: ("matched", "subscription_matched"),
    },
}


def status_mask(side: str) -> int:
    """All status bits of an endpoint whose other side is ``side``."""
    return sum(_STATUSES[side])


def read_events(handle: int, side: str, status: int) -> Iterator[EndpointEvent]:
    """The events behind the bits of ``status``."""
    for bit, (kind, name) in _STATUSES[side].items():
        if not status & bit:
            continue
        result = _Status()
        if getattr(lib, f"dds_get_{name}_status")(handle, ct.byref(result)) < 0:
            return
        first, second, third, fourth = result.numbers
        if name == "liveliness_changed":
            yield EndpointEvent(
                kind,
                current_count=first,
                not_alive_count=second,
                current_count_change=third,
                not_alive_count_change=fourth,
            )
        elif kind == "matched":
            yield EndpointEvent(kind, first, second, third, fourth)
        elif kind == "incompatible_qos":
            yield EndpointEvent(kind, first, second, policy=_POLICIES.get(third, "INVALID"))
        else:
            yield EndpointEvent(kind, first, second)
