"""ROS 2 Jazzy's interfaces: their fields, constants, defaults and type hashes.

The .msg files come from rosbags' type store. Written down here are the services, which it lacks,
and two events of rosbag2 that are newer than Jazzy.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

PLACEHOLDER = "structure_needs_at_least_one_member"

# Services by package: a name, and the fields of its request and of its response.
_SERVICE_TEXTS = {
    "rcl_interfaces": """
        DescribeParameters | string[] names | rcl_interfaces/ParameterDescriptor[] descriptors
        GetParameterTypes | string[] names | uint8[] types
        GetParameters | string[] names | rcl_interfaces/ParameterValue[] values
        ListParameters | uint64 DEPTH_RECURSIVE=0; string[] prefixes; uint64 depth \
            | rcl_interfaces/ListParametersResult result
        SetParameters | rcl_interfaces/Parameter[] parameters \
            | rcl_interfaces/SetParametersResult[] results
        SetParametersAtomically | rcl_interfaces/Parameter[] parameters \
            | rcl_interfaces/SetParametersResult result""",
    "rosbag2_interfaces": """
        Burst | uint64 num_messages | uint64 actually_burst
        GetRate | | float64 rate
        GetSubscribedTopics | | string[] topics
        GetUri | | string uri
        IsDiscoveryRunning | | bool running
        IsPaused | | bool paused
        IsRecording | | bool recording
        Pause | |
        Play | builtin_interfaces/Time start_offset; \
            builtin_interfaces/Duration playback_duration; \
            builtin_interfaces/Time playback_until_timestamp | bool success
        PlayNext | | bool success
        Record | string uri | int32 return_code; string error_string
        Resume | |
        Seek | builtin_interfaces/Time time | bool success
        SetRate | float64 rate | bool success
        Snapshot | | bool success
        SplitBagfile | |
        StartDiscovery | | int32 return_code; string error_string
        Stop | |
        StopDiscovery | | int32 return_code; string error_string
        TogglePaused | |""",
    "std_srvs": """
        Empty | |
        SetBool | bool data | bool success; string message
        Trigger | | bool success; string message""",
}
_SERVICES: dict[str, list[str]] = {}
for _package, _text in _SERVICE_TEXTS.items():
    for _line in _text.strip().splitlines():
        _name, *_parts = _line.split("|")
        _SERVICES[f"{_package}/srv/{_name.strip()}"] = [
            part.strip().replace("; ", "\n") for part in _parts
        ]

# Newer than Jazzy, as are the services Record, GetUri, and those of discovery and IsRecording.
_MESSAGES = {
    "rosbag2_interfaces/msg/MessagesLostEvent": (
        "string node_name\nMessagesLostEventTopicStat[] messages_lost_statistics"
    ),
    "rosbag2_interfaces/msg/MessagesLostEventTopicStat": (
        "string topic_name\nuint64 messages_lost_in_transport\nuint64 messages_lost_in_recorder"
    ),
}

# The defaults that Jazzy's .msg files declare (rosbags drops them).
_DEFAULTS = {
    **{("geometry_msgs/msg/Quaternion", axis): 0.0 for axis in "xyz"},
    ("geometry_msgs/msg/Quaternion", "w"): 1.0,
    ("rcl_interfaces/msg/ParameterDescriptor", "dynamic_typing"): False,
    ("rcl_interfaces/msg/ParameterDescriptor", "read_only"): False,
    ("sensor_msgs/msg/NavSatStatus", "status"): -2,
    ("type_description_interfaces/msg/FieldType", "type_id"): 0,
}

IDL_NAMES = {"bool": "boolean", "byte": "octet", "float32": "float", "float64": "double"}


class InterfaceError(Exception):
    """There is no such message or service."""


@dataclass(frozen=True)
class Field:
    """One field of a message.

    Attributes:
        kind: the primitive's name (``uint8``, ``float64``, ``string``, …) or a message's full name.
        is_message: whether ``kind`` names a message.
        shape: ``scalar``, ``array`` (of ``size`` elements) or ``sequence`` (at most ``size``, 0 for
            unbounded).
        string_bound: the longest string allowed, 0 for any.
        default: the declared default, or None for the type's own.
    """

    name: str
    kind: str
    is_message: bool
    shape: str
    size: int
    string_bound: int
    default: Any

    @property
    def idl_type(self) -> str:
        """The type as rosidl's ``get_fields_and_field_types`` writes it."""
        if self.is_message:
            package, _, name = self.kind.split("/")
            element = f"{package}/{name}"
        else:
            element = IDL_NAMES.get(self.kind, self.kind)
            if self.string_bound:
                element += f"<{self.string_bound}>"
        if self.shape == "array":
            return f"{element}[{self.size}]"
        if self.shape == "sequence":
            return f"sequence<{element}, {self.size}>" if self.size else f"sequence<{element}>"
        return element


@dataclass(frozen=True)
class Interface:
    """A message: its full name (``geometry_msgs/msg/Point``), fields and constants."""

    name: str
    fields: tuple[Field, ...]
    constants: dict[str, Any]


@cache
def interface(name: str) -> Interface:
    """The message ``name``; requests and responses are ``pkg/srv/Name_Request`` and so on.

    Raises:
        InterfaceError: Jazzy's type store has no such message.
    """
    definitions = _typestore().fielddefs
    if name not in definitions:
        raise InterfaceError(
            f"there is no message {name!r} in the ROS 2 Jazzy type store; "
            f"names look like 'sensor_msgs/msg/Image'"
        )
    constants, fields = definitions[name]
    return Interface(
        name=name,
        fields=tuple(_field(name, *field) for field in fields if field[0] != PLACEHOLDER),
        constants={
            constant: bytes([value]) if kind == "byte" else value  # type: ignore[list-item]
            for constant, kind, value in constants
        },
    )


def message_names(package: str) -> list[str]:
    """The short names of a package's messages, sorted."""
    return _short_names(_typestore().fielddefs, f"{package}/msg/")


def service_names(package: str) -> list[str]:
    """The short names of a package's services, sorted."""
    return _short_names(_SERVICES, f"{package}/srv/")


def _short_names(names: Iterable[str], prefix: str) -> list[str]:
    return sorted(name.removeprefix(prefix) for name in names if name.startswith(prefix))


def packages() -> list[str]:
    """The packages that have messages or services, sorted."""
    names = [*_typestore().fielddefs, *_SERVICES]
    return sorted({name.split("/")[0] for name in names})


def dds_name(name: str) -> str:
    """The name of a type in DDS: ``sensor_msgs::msg::dds_::Image_`` is sensor_msgs/msg/Image."""
    package, folder, short = name.split("/")
    return f"{package}::{folder}::dds_::{short}_"


@cache
def type_hash(name: str) -> str:
    """The ``RIHS01_…`` hash of a message, service, request or response (REP 2016).

    Raises:
        InterfaceError: there is no such type.
    """
    store = _typestore()
    if name not in store.fielddefs:
        raise InterfaceError(f"there is no interface {name!r} in the ROS 2 Jazzy type store")
    return store.hash_rihs01(name)


@cache
def _typestore() -> Any:
    """rosbags' Jazzy store with the services' messages, as rosidl derives them, added."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, (constants, fields) in store.fielddefs.items():
        store.fielddefs[name] = constants, [(field, _without_char(kind)) for field, kind in fields]
    for message, text in _MESSAGES.items():
        store.fielddefs.update(get_types_from_msg(text, message))
    for service, texts in _SERVICES.items():
        package = service.split("/")[0]
        for part, text in zip(("Request", "Response"), texts, strict=True):
            name = f"{service}_{part}"
            # The parser only takes names in msg/, so give it one and move the result.
            parsed = get_types_from_msg(text, f"{package}/msg/Moved")[f"{package}/msg/Moved"]
            store.fielddefs[name] = parsed
        store.fielddefs.update(_service_fields(service))
    return store


def _service_fields(service: str) -> dict[str, Any]:
    """A service as a type, and its event, as rosidl describes both (REP 2016)."""

    def field(name: str, kind: str) -> tuple[str, Any]:
        return name, (Nodetype.NAME, kind)

    def at_most_one(name: str, kind: str) -> tuple[str, Any]:
        return name, (Nodetype.SEQUENCE, ((Nodetype.NAME, kind), 1))

    request, response, event = (f"{service}_{part}" for part in ("Request", "Response", "Event"))
    return {
        event: (
            [],
            [
                field("info", "service_msgs/msg/ServiceEventInfo"),
                at_most_one("request", request),
                at_most_one("response", response),
            ],
        ),
        service: (
            [],
            [
                field("request_message", request),
                field("response_message", response),
                field("event_message", event),
            ],
        ),
    }


def _without_char(description: Any) -> Any:
    """The description with uint8 for char, which in ROS 2 is only another name for it."""
    kind, content = description
    if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        return kind, (_without_char(content[0]), content[1])
    return (kind, ("uint8", 0)) if content == ("char", 0) else description


def _field(owner: str, name: str, description: Any) -> Field:
    shape, size = "scalar", 0
    if description[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        shape = "array" if description[0] == Nodetype.ARRAY else "sequence"
        description, size = description[1]
    is_message = description[0] == Nodetype.NAME
    kind, bound = (description[1], 0) if is_message else description[1]
    return Field(name, kind, is_message, shape, size, bound, _DEFAULTS.get((owner, name)))
