"""Message definitions for a bag: the text of a type with all it refers to, and its RIHS01 hash.

Where ROS 2 is installed they are of the installed ``.msg`` files, elsewhere those of Jazzy.
"""

from __future__ import annotations

import os
import re
from functools import cache
from pathlib import Path
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from us_sim.errors import BagError

_TYPE_NAME = re.compile(r"([a-zA-Z]\w*)/(?:msg/)?([a-zA-Z]\w*)")
_Fields = dict[str, tuple[Any, list[Any]]]  # constants and fields, by type, as rosbags has them


def normalize_type(name: str) -> str:
    """Return ``pkg/msg/Type`` for ``pkg/Type`` of early ROS 2 bags, other names unchanged."""
    package, _, rest = name.partition("/")
    return f"{package}/msg/{rest}" if rest and "/" not in rest else name


def make_schema(type_name: str) -> str:
    """Return the ``ros2msg`` schema of ``pkg/msg/Type``, followed by every type that it refers to.

    Raises:
        BagError: neither an installed package nor rosbags' Jazzy types define it.
    """
    return _installed(type_name, _prefixes()).generate_msgdef(type_name, ros_version=2)[0]


def compute_type_hash(type_name: str) -> str:
    """Return the hash of ``pkg/msg/Type`` (REP 2016), as ROS 2 announces it with each endpoint.

    Raises:
        BagError: the type is not known.
    """
    return _installed(type_name, _prefixes()).hash_rihs01(type_name)


@cache
def parse_definitions(type_name: str, text: str) -> Typestore:
    """Parse the types that a schema's text defines.

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
def load_jazzy_definitions() -> Typestore:
    """Return the message types of ROS 2 Jazzy; the first call takes a twentieth of a second."""
    return get_typestore(Stores.ROS2_JAZZY)


def serialize_stamped(type_name: str, stamp: int, frame_id: str, **fields: Any) -> memoryview:
    """Serialize a message of Jazzy with a header and these fields; ``stamp`` in ns since 1970."""
    store = load_jazzy_definitions()
    time = store.types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9))
    header = store.types["std_msgs/msg/Header"](stamp=time, frame_id=frame_id)
    message = store.types[type_name](header=header, **fields)
    return store.serialize_cdr(message, type_name, little_endian=True)


def _prefixes() -> str:
    return os.environ.get("AMENT_PREFIX_PATH", "")


@cache
def _installed(type_name: str, prefixes: str) -> Typestore:
    """Return a type with every one that it refers to."""
    found: _Fields = {}
    wanted = [type_name]
    while wanted:
        name = wanted.pop()
        if name not in found:
            found |= _definition(name, prefixes)
            wanted += [other for _, kind in found[name][1] for other in _named(kind)]
    store = get_typestore(Stores.EMPTY)
    store.register(found)
    return store


def _named(kind: Any) -> list[str]:
    """Return the message that a field, or each element of one, is."""
    node, content = kind
    if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        return _named(content[0])
    return [content] if node == Nodetype.NAME else []


def _definition(type_name: str, prefixes: str) -> _Fields:
    """Read one message, without those that it refers to."""
    match = _TYPE_NAME.fullmatch(type_name)
    if match is None:
        raise BagError(f"{type_name!r} is not a message type: write it as package/msg/Type")
    package, name = match.groups()
    for prefix in filter(None, prefixes.split(os.pathsep)):
        file = Path(prefix, "share", package, "msg", f"{name}.msg")
        if file.is_file():
            return get_types_from_msg(file.read_text(encoding="utf-8"), type_name)
    known = load_jazzy_definitions().fielddefs
    if type_name not in known:
        raise BagError(
            f"message type {type_name} is unknown: install the ROS 2 package {package} and source "
            f"its setup file, or leave topics of this type out"
        )
    return {type_name: known[type_name]}
