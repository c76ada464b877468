"""Message classes by names that come from outside: from the network, or from a file."""

from __future__ import annotations

import importlib
import re
from typing import Any

from us_sim.errors import BagError
from us_sim.recording.schemas import schema_text

_TYPE = re.compile(r"([a-z][a-z0-9_]*)/msg/([A-Z][A-Za-z0-9]*)")
"""What a message type of ROS 2 is called."""


def message_type(name: str) -> Any:
    """The class of a message type, of which a definition is known.

    Nothing is imported for a name that is not known to be a message's: importing runs code.

    Raises:
        BagError: it is no message type's name, has no definition here, or its package for Python
            is not installed.
    """
    match = _TYPE.fullmatch(name)
    if match is None:
        shown = name if len(name) < 100 else f"{name[:100]}…"
        raise BagError(f"{shown!r} is no message type of ROS 2")
    schema_text(name)
    package, short = match.groups()
    try:
        return getattr(importlib.import_module(f"{package}.msg"), short)
    except (ImportError, AttributeError):
        raise BagError(
            f"message type {name} cannot be imported: install the ROS 2 package {package} and "
            f"source its setup file"
        ) from None
