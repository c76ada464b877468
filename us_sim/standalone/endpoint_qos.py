"""Quality of service between rclpy's policies and Cyclone DDS's.

Durations are nanoseconds; 0 stands for "not specified", which is infinite, as in rmw.

>>> from us_sim.standalone.endpoint_qos import EndpointQos
>>> latched = EndpointQos(depth=1, durability=EndpointQos.TRANSIENT_LOCAL)
>>> latched.reliability == EndpointQos.RELIABLE
True
"""

from __future__ import annotations

import ctypes as ct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, ClassVar

from .ddsc import INFINITY, DdsError, lib

_UNSPECIFIED = (0, INFINITY)
_LONGEST_BLOCK = 100_000_000  # ns; DDS's own default, where rmw_cyclonedds would block for ever


@dataclass(frozen=True)
class EndpointQos:
    """The policies of one endpoint, with the numbers that rclpy's enumerations have."""

    RELIABLE: ClassVar[int] = 1
    BEST_EFFORT: ClassVar[int] = 2
    TRANSIENT_LOCAL: ClassVar[int] = 1
    VOLATILE: ClassVar[int] = 2
    KEEP_LAST: ClassVar[int] = 1
    KEEP_ALL: ClassVar[int] = 2
    AUTOMATIC: ClassVar[int] = 1
    MANUAL_BY_TOPIC: ClassVar[int] = 3

    reliability: int = RELIABLE
    durability: int = VOLATILE
    history: int = KEEP_LAST
    depth: int = 10
    deadline: int = 0  # ns
    lifespan: int = 0  # ns
    liveliness: int = AUTOMATIC
    liveliness_lease_duration: int = 0  # ns


_DDS_DURABILITY = (EndpointQos.VOLATILE, EndpointQos.TRANSIENT_LOCAL)
_DDS_LIVELINESS = (EndpointQos.AUTOMATIC, 2, EndpointQos.MANUAL_BY_TOPIC)

# The values of each policy that are not left to the middleware, its default first.
_KNOWN = {
    "reliability": (EndpointQos.RELIABLE, EndpointQos.BEST_EFFORT),
    "durability": _DDS_DURABILITY,
    "history": (EndpointQos.KEEP_LAST, EndpointQos.KEEP_ALL),
    "liveliness": (EndpointQos.AUTOMATIC, EndpointQos.MANUAL_BY_TOPIC),
}


def qos_of_profile(profile: Any) -> EndpointQos:
    """The policies to ask for, given rclpy's profile (or anything with its attributes).

    SYSTEM_DEFAULT is reliable, volatile, keep last 1 and automatic.

    Raises:
        DdsError: a policy is UNKNOWN or BEST_AVAILABLE, or the depth is negative.
    """
    depth = int(profile.depth)
    if depth < 0:
        raise DdsError(f"a history depth of {depth} cannot be kept; give at least 1")
    policies = {}
    for name, known in _KNOWN.items():
        policies[name] = int(getattr(profile, name)) or known[0]
        if policies[name] not in known:
            raise DdsError(
                f"the {name} policy {getattr(profile, name)!r} cannot be asked for; choose one "
                f"that says what this endpoint needs"
            )
    for name in ("deadline", "lifespan", "liveliness_lease_duration"):
        value = getattr(profile, name)
        policies[name] = _specified(int(getattr(value, "nanoseconds", value)))
    return EndpointQos(depth=depth or 1, **policies)


@contextmanager
def dds_qos(qos: EndpointQos, data: str, ignore_own: bool = False) -> Iterator[int]:
    """A dds_qos_t with these policies and USER_DATA, deleted at the end."""
    with participant_qos(data) as handle:
        is_latched = qos.durability == EndpointQos.TRANSIENT_LOCAL
        keeps_all = qos.history == EndpointQos.KEEP_ALL
        history = (1, -1) if keeps_all else (0, qos.depth)
        lib.dds_qset_writer_data_lifecycle(handle, False)
        lib.dds_qset_history(handle, *history)
        lib.dds_qset_reliability(
            handle, int(qos.reliability == EndpointQos.RELIABLE), _LONGEST_BLOCK
        )
        lib.dds_qset_durability(handle, int(is_latched))
        if is_latched:
            lib.dds_qset_durability_service(handle, 0, *history, -1, -1, -1)
        lib.dds_qset_lifespan(handle, qos.lifespan or INFINITY)
        lib.dds_qset_deadline(handle, qos.deadline or INFINITY)
        lib.dds_qset_liveliness(
            handle,
            _DDS_LIVELINESS.index(qos.liveliness),
            qos.liveliness_lease_duration or INFINITY,
        )
        lib.dds_qset_data_representation(handle, 1, (ct.c_int16 * 1)(0))
        lib.dds_qset_ignorelocal(handle, int(ignore_own))
        yield handle


@contextmanager
def participant_qos(data: str) -> Iterator[int]:
    """A dds_qos_t with nothing but USER_DATA, deleted at the end."""
    handle = lib.dds_create_qos()
    try:
        lib.dds_qset_userdata(handle, data.encode(), len(data.encode()))
        yield handle
    finally:
        lib.dds_delete_qos(handle)


def read_qos(handle: int | None) -> EndpointQos:
    """The policies in a dds_qos_t."""
    kind, depth, duration = ct.c_int(), ct.c_int32(), ct.c_int64()
    found: dict[str, int] = {}
    if not handle:
        return EndpointQos()
    if lib.dds_qget_reliability(handle, ct.byref(kind), None):
        found["reliability"] = EndpointQos.RELIABLE if kind.value else EndpointQos.BEST_EFFORT
    if lib.dds_qget_durability(handle, ct.byref(kind)):
        found["durability"] = _DDS_DURABILITY[min(kind.value, 1)]
    if lib.dds_qget_history(handle, ct.byref(kind), ct.byref(depth)):
        keeps_all = kind.value == 1
        found |= {"history": 1 + keeps_all, "depth": 0 if keeps_all else depth.value}
    if lib.dds_qget_liveliness(handle, ct.byref(kind), ct.byref(duration)):
        found["liveliness"] = _DDS_LIVELINESS[kind.value]
        found["liveliness_lease_duration"] = _specified(duration.value)
    for name in ("deadline", "lifespan"):
        if getattr(lib, f"dds_qget_{name}")(handle, ct.byref(duration)):
            found[name] = _specified(duration.value)
    return EndpointQos(**found)


def user_data(handle: int | None) -> dict[str, str]:
    """The ``key=value;`` pairs in a dds_qos_t's USER_DATA."""
    value, size = ct.c_void_p(), ct.c_size_t()
    if not handle or not lib.dds_qget_userdata(handle, ct.byref(value), ct.byref(size)):
        return {}
    if not value.value:
        return {}
    text = ct.string_at(value.value, size.value).decode("utf-8", "replace")
    lib.dds_free(value)
    pairs = (part.partition("=") for part in text.split(";") if "=" in part)
    return {key: content for key, _, content in pairs}


def _specified(duration: int) -> int:
    return 0 if duration in _UNSPECIFIED else duration
