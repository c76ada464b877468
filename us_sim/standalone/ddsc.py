"""Eclipse Cyclone DDS's C interface, as far as serialized samples need it, and quality of service.

The C library comes with the PyPI package `cyclonedds` or from elsewhere (`libddsc`). The package's
Python classes are not used: they hold the interpreter's lock while a write blocks, describe every
type by XTypes (which Jazzy does not send and need not agree with), and turn each sample into
objects. Calls through ctypes release the lock.
"""

from __future__ import annotations

import ctypes as ct
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from .libddsc import DdsError, load
from .middleware import UNSPECIFIED, EndpointQos

INFINITY = 2**63 - 1
ANY_STATE = 0x7F
ALIVE = 16
SAMPLE_OF_DATA = 2  # enum ddsi_serdata_kind

RETURN_TIMEOUT = -10

BUILTIN_PARTICIPANT = 0x7FFF0001
BUILTIN_PUBLICATION = 0x7FFF0003
BUILTIN_SUBSCRIPTION = 0x7FFF0004

InstanceHandle = ct.c_uint64
Pointer = ct.c_void_p


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


def topic_descriptor(type_name: str) -> Any:
    """A description that lets any CDR of at least one byte through, under the given type name.

    ROS 2 matches endpoints by the names of topic and type and sends no XTypes information; so a
    type of one octet will do, and whatever follows the octet travels along untouched.
    """
    operations = (ct.c_uint32 * 3)(_OPERATION_OF_ONE_OCTET, 0, 0)
    return _TopicDescriptor(
        size=1,
        align=1,
        type_name=type_name.encode(),
        operation_count=2,
        operations=operations,
        meta=b"",
    )


# The functions that are called, by the types of what they return and take:
# i int32 (entities too), u uint32, n size_t, l int64, h uint64, b bool, s text, p pointer,
# E a pointer to an endpoint, - nothing.
_C_TYPES = {
    "i": ct.c_int32,
    "u": ct.c_uint32,
    "n": ct.c_size_t,
    "l": ct.c_int64,
    "h": ct.c_uint64,
    "b": ct.c_bool,
    "s": ct.c_char_p,
    "p": ct.c_void_p,
    "E": ct.POINTER(BuiltinEndpoint),
    "-": None,
}
_SIGNATURES = """
    l: dds_time
    s i: dds_strretcode
    - p: dds_free dds_delete_qos ddsi_serdata_unref
    - E: dds_builtintopic_free_endpoint
    - pp: ddsi_serdata_to_ser_unref
    p: dds_create_qos
    i us: dds_create_domain
    i upp: dds_create_participant
    i ipspp: dds_create_topic
    i iipp: dds_create_reader dds_create_writer
    i i: dds_delete dds_create_waitset dds_create_guardcondition
    i ip: dds_get_guid dds_get_instance_handle dds_take_guardcondition
    i ip: dds_get_offered_incompatible_qos_status dds_get_requested_incompatible_qos_status
    i ip: dds_write dds_writecdr
    i ib: dds_set_guardcondition
    i iin: dds_waitset_attach
    i ipnl: dds_waitset_wait
    i iu: dds_set_status_mask
    i ipu: dds_take_status
    i ipupu: dds_takecdr
    i ippnu: dds_take
    i ipi: dds_return_loan
    i ipn: dds_get_matched_subscriptions dds_get_matched_publications
    E ih: dds_get_matched_subscription_data dds_get_matched_publication_data
    p pinpn: ddsi_serdata_from_ser_iov
    p pnnp: ddsi_serdata_to_ser_ref
    u p: ddsi_serdata_size
    - pup: dds_qset_data_representation
    - pl: dds_qset_deadline dds_qset_lifespan
    - pi: dds_qset_durability dds_qset_ignorelocal
    - pliiiii: dds_qset_durability_service
    - pii: dds_qset_history
    - pil: dds_qset_liveliness dds_qset_reliability
    - psn: dds_qset_userdata
    - pb: dds_qset_writer_data_lifecycle
    b pp: dds_qget_deadline dds_qget_durability dds_qget_lifespan
    b ppp: dds_qget_history dds_qget_liveliness dds_qget_reliability dds_qget_userdata
"""
_CALLS = {
    name: list(types.replace(" ", ""))
    for types, _, names in (line.partition(": ") for line in _SIGNATURES.strip().splitlines())
    for name in names.split()
}

lib: Any = load(_CALLS)
for _name, (_result, *_arguments) in _CALLS.items():
    _function = getattr(lib, _name)
    _function.restype = _C_TYPES[_result]
    _function.argtypes = [_C_TYPES[_argument] for _argument in _arguments]


def check(returned: int, sentence: str) -> int:
    """The returned number; raises a DdsError with this sentence if it is an error code."""
    if returned < 0:
        reason = lib.dds_strretcode(returned).decode()
        raise DdsError(f"{sentence} (Cyclone DDS says: {reason})")
    return returned


def guid_of(entity: int) -> bytes:
    """The sixteen bytes that identify an entity on the network."""
    guid = (ct.c_uint8 * 16)()
    check(lib.dds_get_guid(entity, guid), "an endpoint that was closed has no identity")
    return bytes(guid)


_TYPE_OF_SAMPLE = 24  # bytes into ddsi_serdata: its operations, hash, references, kind, type


def serialized_type(writer: int, participant: int, type_name: str) -> ct.c_void_p:
    """Cyclone's own description of a writer's type, which has this name.

    Version 0.10 does not tell it, but each sample points to it; so one is sent to oneself, on a
    topic of its own.
    """
    found = ct.c_void_p()
    if hasattr(lib, "dds_get_entity_sertype"):
        check(lib.dds_get_entity_sertype(writer, ct.byref(found)), "the writer has no type")
        return found
    descriptor = topic_descriptor(type_name)
    topic = check(
        lib.dds_create_topic(participant, ct.byref(descriptor), b"us_sim/type", None, None),
        f"there can be no type {type_name!r}",
    )
    made = [topic]
    try:
        for create in (lib.dds_create_reader, lib.dds_create_writer):
            made.append(check(create(participant, topic, None, None), "no endpoint can be made"))
        check(lib.dds_write(made[2], ct.byref(ct.c_uint8())), "no sample can be written")
        sample, info = ct.c_void_p(), RawSampleInfo()
        taken = lib.dds_takecdr(made[1], ct.byref(sample), 1, ct.byref(info), ANY_STATE)
        if taken != 1 or not sample.value:
            raise DdsError("Cyclone DDS did not hand over a sample of its own")
        found.value = ct.c_void_p.from_address(sample.value + _TYPE_OF_SAMPLE).value
        lib.ddsi_serdata_unref(sample)
        return found
    finally:
        for entity in reversed(made):
            lib.dds_delete(entity)


_LONGEST_BLOCK = 100_000_000  # ns; DDS's own default, where rmw_cyclonedds would block for ever


_DDS_DURABILITY = (EndpointQos.VOLATILE, EndpointQos.TRANSIENT_LOCAL)
_DDS_LIVELINESS = (EndpointQos.AUTOMATIC, 2, EndpointQos.MANUAL_BY_TOPIC)


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
    return 0 if duration in UNSPECIFIED else duration
