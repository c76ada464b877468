"""Eclipse Cyclone DDS's C interface, as far as serialized samples need it, and quality of service.

The C library comes with the PyPI package `cyclonedds`. Its Python classes are not used: they hold
the interpreter's lock while a write blocks, describe every type by XTypes (which Jazzy does not
send and need not agree with), and turn each sample into objects. Calls through ctypes release the
lock.

>>> from us_sim.standalone.ddsc import EndpointQos, lib
>>> lib.dds_time() > 0
True
>>> latched = EndpointQos(depth=1, durability=EndpointQos.TRANSIENT_LOCAL)
>>> latched.reliability == EndpointQos.RELIABLE
True
"""

from __future__ import annotations

import ctypes as ct
import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

INFINITY = 2**63 - 1
ANY_STATE = 0x7F
ALIVE = 16
SAMPLE_OF_DATA = 2  # enum ddsi_serdata_kind

RETURN_TIMEOUT = -10

BUILTIN_PARTICIPANT = 0x7FFF0001
BUILTIN_PUBLICATION = 0x7FFF0003
BUILTIN_SUBSCRIPTION = 0x7FFF0004

Entity = ct.c_int32
InstanceHandle = ct.c_uint64
Pointer = ct.c_void_p


class DdsError(Exception):
    """The transport refuses what it was asked for."""


class RawSampleInfo(ct.Structure):
    """dds_sample_info_t"""

    _fields_ = (
        ("sample_state", ct.c_uint),
        ("view_state", ct.c_uint),
        ("instance_state", ct.c_uint),
        ("valid_data", ct.c_bool),
        ("source_timestamp", ct.c_int64),
        ("instance_handle", InstanceHandle),
        ("publication_handle", InstanceHandle),
        ("disposed_generation_count", ct.c_uint32),
        ("no_writers_generation_count", ct.c_uint32),
        ("sample_rank", ct.c_uint32),
        ("generation_rank", ct.c_uint32),
        ("absolute_generation_rank", ct.c_uint32),
    )


class IoVector(ct.Structure):
    """ddsrt_iovec_t"""

    _fields_ = (("base", Pointer), ("length", ct.c_size_t))


class BuiltinParticipant(ct.Structure):
    """dds_builtintopic_participant_t"""

    _fields_ = (("key", ct.c_uint8 * 16), ("qos", Pointer))


class BuiltinEndpoint(ct.Structure):
    """dds_builtintopic_endpoint_t"""

    _fields_ = (
        ("key", ct.c_uint8 * 16),
        ("participant_key", ct.c_uint8 * 16),
        ("participant_handle", InstanceHandle),
        ("topic_name", ct.c_char_p),
        ("type_name", ct.c_char_p),
        ("qos", Pointer),
    )


class _SerializedType(ct.Structure):
    _fields_ = (("data", Pointer), ("size", ct.c_uint32))


class _TopicDescriptor(ct.Structure):
    """dds_topic_descriptor_t"""

    _fields_ = (
        ("size", ct.c_uint32),
        ("align", ct.c_uint32),
        ("flags", ct.c_uint32),
        ("key_count", ct.c_uint32),
        ("type_name", ct.c_char_p),
        ("keys", Pointer),
        ("operation_count", ct.c_uint32),
        ("operations", ct.POINTER(ct.c_uint32)),
        ("meta", ct.c_char_p),
        ("type_information", _SerializedType),
        ("type_mapping", _SerializedType),
        ("data_representation", ct.c_uint32),
    )


_OPERATION_OF_ONE_OCTET = (1 << 24) | (1 << 16)  # DDS_OP_ADR | DDS_OP_TYPE_1BY, then its offset
_XCDR1_ONLY = (1 << 8, 1 << 0)  # DDS_TOPIC_RESTRICT_DATA_REPRESENTATION and the flag for XCDR1


def topic_descriptor(type_name: str) -> Any:
    """A description that lets any CDR of at least one byte through, under the given type name.

    ROS 2 matches endpoints by the names of topic and type and sends no XTypes information; so a
    type of one octet will do, and whatever follows the octet travels along untouched.
    """
    operations = (ct.c_uint32 * 3)(_OPERATION_OF_ONE_OCTET, 0, 0)
    return _TopicDescriptor(
        size=1,
        align=1,
        flags=0,
        type_name=type_name.encode(),
        operation_count=2,
        operations=operations,
        meta=b"",
    )


def _declare(result: Any, name: str, *arguments: Any) -> None:
    function = getattr(lib, name)
    function.restype = result
    function.argtypes = arguments


def _library_path() -> str:
    """The C library in the `cyclonedds` package, without importing that (0.2 s)."""
    package = importlib.util.find_spec("cyclonedds")
    if package is None or package.origin is None:
        raise DdsError("the package cyclonedds is not installed; run pip install cyclonedds")
    folder = Path(package.origin).parent
    for place in (folder.parent / "cyclonedds.libs", folder / ".dylibs"):
        for library in sorted(place.glob("*ddsc[.-]*")):
            return str(library)
    from cyclonedds.internal import DDS  # built from source, it knows where its library is

    return DDS._dll_handle._name


lib: Any = ct.CDLL(_library_path())
_INT, _BOOL, _OUT = ct.c_int32, ct.c_bool, ct.c_void_p
_DURATION = ct.c_int64

_declare(ct.c_int64, "dds_time")
_declare(ct.c_char_p, "dds_strretcode", _INT)
_declare(None, "dds_free", Pointer)

_declare(_INT, "dds_create_domain", ct.c_uint32, ct.c_char_p)
_declare(_INT, "dds_create_participant", ct.c_uint32, Pointer, Pointer)
_declare(_INT, "dds_create_topic", Entity, Pointer, ct.c_char_p, Pointer, Pointer)
_declare(_INT, "dds_create_reader", Entity, Entity, Pointer, Pointer)
_declare(_INT, "dds_create_writer", Entity, Entity, Pointer, Pointer)
_declare(_INT, "dds_delete", Entity)
_declare(_INT, "dds_get_guid", Entity, _OUT)
_declare(_INT, "dds_get_instance_handle", Entity, _OUT)
_declare(_INT, "dds_get_entity_sertype", Entity, _OUT)

_declare(_INT, "dds_create_waitset", Entity)
_declare(_INT, "dds_create_guardcondition", Entity)
_declare(_INT, "dds_set_guardcondition", Entity, _BOOL)
_declare(_INT, "dds_take_guardcondition", Entity, _OUT)
_declare(_INT, "dds_waitset_attach", Entity, Entity, ct.c_ssize_t)
_declare(_INT, "dds_waitset_wait", Entity, _OUT, ct.c_size_t, _DURATION)
_declare(_INT, "dds_set_status_mask", Entity, ct.c_uint32)
_declare(_INT, "dds_take_status", Entity, _OUT, ct.c_uint32)

_declare(Pointer, "ddsi_serdata_from_ser_iov", Pointer, ct.c_int, ct.c_size_t, _OUT, ct.c_size_t)
_declare(ct.c_uint32, "ddsi_serdata_size", Pointer)
_declare(Pointer, "ddsi_serdata_to_ser_ref", Pointer, ct.c_size_t, ct.c_size_t, _OUT)
_declare(None, "ddsi_serdata_to_ser_unref", Pointer, _OUT)
_declare(None, "ddsi_serdata_unref", Pointer)
_declare(_INT, "dds_writecdr", Entity, Pointer)
_declare(_INT, "dds_takecdr", Entity, _OUT, ct.c_uint32, _OUT, ct.c_uint32)
_declare(_INT, "dds_take", Entity, _OUT, _OUT, ct.c_size_t, ct.c_uint32)
_declare(_INT, "dds_return_loan", Entity, _OUT, ct.c_int32)

_declare(_INT, "dds_get_matched_subscriptions", Entity, _OUT, ct.c_size_t)
_declare(_INT, "dds_get_matched_publications", Entity, _OUT, ct.c_size_t)
for _side in ("publication", "subscription"):
    _declare(ct.POINTER(BuiltinEndpoint), f"dds_get_matched_{_side}_data", Entity, InstanceHandle)
_declare(None, "dds_builtintopic_free_endpoint", ct.POINTER(BuiltinEndpoint))
_declare(_INT, "dds_get_offered_incompatible_qos_status", Entity, _OUT)
_declare(_INT, "dds_get_requested_incompatible_qos_status", Entity, _OUT)

_declare(Pointer, "dds_create_qos")
_declare(None, "dds_delete_qos", Pointer)
_declare(None, "dds_qset_data_representation", Pointer, ct.c_uint32, _OUT)
_declare(None, "dds_qset_deadline", Pointer, _DURATION)
_declare(None, "dds_qset_durability", Pointer, ct.c_int)
_declare(None, "dds_qset_durability_service", Pointer, _DURATION, ct.c_int, *(ct.c_int32,) * 4)
_declare(None, "dds_qset_history", Pointer, ct.c_int, ct.c_int32)
_declare(None, "dds_qset_ignorelocal", Pointer, ct.c_int)
_declare(None, "dds_qset_lifespan", Pointer, _DURATION)
_declare(None, "dds_qset_liveliness", Pointer, ct.c_int, _DURATION)
_declare(None, "dds_qset_reliability", Pointer, ct.c_int, _DURATION)
_declare(None, "dds_qset_userdata", Pointer, ct.c_char_p, ct.c_size_t)
_declare(None, "dds_qset_writer_data_lifecycle", Pointer, _BOOL)
_declare(_BOOL, "dds_qget_deadline", Pointer, _OUT)
_declare(_BOOL, "dds_qget_durability", Pointer, _OUT)
_declare(_BOOL, "dds_qget_history", Pointer, _OUT, _OUT)
_declare(_BOOL, "dds_qget_lifespan", Pointer, _OUT)
_declare(_BOOL, "dds_qget_liveliness", Pointer, _OUT, _OUT)
_declare(_BOOL, "dds_qget_reliability", Pointer, _OUT, _OUT)
_declare(_BOOL, "dds_qget_userdata", Pointer, _OUT, _OUT)


def check(returned: int, sentence: str) -> int:
    """What a C function returned, or a DdsError with this sentence if it was an error."""
    if returned < 0:
        reason = lib.dds_strretcode(returned).decode()
        raise DdsError(f"{sentence} (Cyclone DDS says: {reason})")
    return returned


def guid_of(entity: int) -> bytes:
    """The sixteen bytes that identify an entity on the network."""
    guid = (ct.c_uint8 * 16)()
    check(lib.dds_get_guid(entity, guid), "an endpoint that was closed has no identity")
    return bytes(guid)


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
