"""Message definitions for a bag: the text of a type with all it refers to, and its RIHS01 hash.

Where ROS 2 is installed the text is the installed ``.msg`` file, comments and all, exactly as
rosbag2 writes it; elsewhere the definition of the same fields comes from rosbags.
"""

from __future__ import annotations

import os
import re
from functools import cache
from pathlib import Path
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from us_sim.errors import BagError

_RULE = "=" * 80
_PRIMITIVES = {"bool", "byte", "char", "float32", "float64", "string", "wstring"} | {
    f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)
}
_FIELD_TYPE = re.compile(r"^\s*([a-zA-Z0-9_/]+)(?:\[[^\]]*\])?\s+", re.MULTILINE)
"""A field starts with its type; a constant or comment never names a message type."""

_TYPE_NAME = re.compile(r"([a-zA-Z]\w*)/(?:msg/)?([a-zA-Z]\w*)")

_DEFAULTS = {
    "geometry_msgs/msg/Quaternion": {
        "float64 x": "float64 x 0",
        "float64 y": "float64 y 0",
        "float64 z": "float64 z 0",
        "float64 w": "float64 w 1",
    }
}
"""rosbags keeps no default values, and this is the one message of common_interfaces with any."""


def normalized_type(name: str) -> str:
    """``pkg/msg/Type`` for ``pkg/Type``, which early ROS 2 bags wrote; other names unchanged."""
    package, _, rest = name.partition("/")
    return f"{package}/msg/{rest}" if rest and "/" not in rest else name


def schema_text(type_name: str) -> str:
    """The ``ros2msg`` schema of ``pkg/msg/Type``, followed by every type that it refers to.

    The order is rosbag2's: depth first, the types that one message refers to by name.

    Raises:
        BagError: neither an installed package nor rosbags' Jazzy types define it.
    """
    return _schema_text(type_name, os.environ.get("AMENT_PREFIX_PATH", ""))


def type_hash(type_name: str) -> str:
    """The hash of ``pkg/msg/Type`` (REP 2016), as ROS 2 announces it with each endpoint.

    Raises:
        BagError: the type is not known.
    """
    store = jazzy_definitions()
    if type_name not in store.fielddefs or os.environ.get("ROS_DISTRO", "jazzy") != "jazzy":
        store = definitions(type_name, schema_text(type_name))
    return store.hash_rihs01(type_name)


@cache
def definitions(type_name: str, text: str) -> Typestore:
    """The types that a schema's text defines.

    Raises:
        BagError: the text is not a message definition.
    """
    store = get_typestore(Stores.EMPTY)
    try:
        store.register(get_types_from_msg(text, type_name))
        store.get_msgdef(type_name)
    except Exception as error:
        # The parser and the code generator raise whatever they stumble over.
        reason = (str(error).splitlines() or [type(error).__name__])[0].rstrip(":")
        raise BagError(f"the definition of {type_name} cannot be understood: {reason}") from None
    return store


@cache
def jazzy_definitions() -> Typestore:
    """The message types of ROS 2 Jazzy; the first call takes a twentieth of a second."""
    return get_typestore(Stores.ROS2_JAZZY)


def stamped(type_name: str, stamp: int, frame_id: str, **fields: Any) -> memoryview:
    """A message of Jazzy with a header and these fields as CDR; ``stamp`` in ns since the epoch."""
    store = jazzy_definitions()
    time = store.types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9))
    header = store.types["std_msgs/msg/Header"](stamp=time, frame_id=frame_id)
    message = store.types[type_name](header=header, **fields)
    return store.serialize_cdr(message, type_name, little_endian=True)


@cache
def _schema_text(type_name: str, prefixes: str) -> str:
    parts: list[str] = []
    seen = {type_name}

    def append(name: str) -> None:
        text = _definition(name, prefixes)
        parts.append(text if not parts else f"{_RULE}\nMSG: {name.replace('/msg/', '/')}\n{text}")
        package = name.split("/")[0]
        referred = {field.group(1) for field in _FIELD_TYPE.finditer(text)} - _PRIMITIVES
        for short in sorted(short if "/" in short else f"{package}/{short}" for short in referred):
            dependency = normalized_type(short)
            if dependency not in seen:
                seen.add(dependency)
                append(dependency)

    append(type_name)
    return "\n".join(parts)


def _definition(type_name: str, prefixes: str) -> str:
    """The text of one message, without those that it refers to."""
    match = _TYPE_NAME.fullmatch(type_name)
    if match is None:
        raise BagError(f"{type_name!r} is not a message type: write it as package/msg/Type")
    package, name = match.groups()
    for prefix in filter(None, prefixes.split(os.pathsep)):
        file = Path(prefix, "share", package, "msg", f"{name}.msg")
        if file.is_file():
            return file.read_bytes().decode("utf-8")
    store = jazzy_definitions()
    if type_name not in store.fielddefs:
        raise BagError(
            f"message type {type_name} is unknown: install the ROS 2 package {package} and source "
            f"its setup file, or leave topics of this type out"
        )
    text = store.generate_msgdef(type_name, ros_version=2)[0].split(_RULE)[0]
    defaults = _DEFAULTS.get(type_name, {})
    return "".join(f"{defaults.get(line, line)}\n" for line in text.splitlines())
