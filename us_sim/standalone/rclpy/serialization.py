"""Messages to bytes and back."""

from typing import Any

from ..messages import deserialize, serialize
from .exceptions import NoTypeSupportImportedException


def serialize_message(message: Any) -> bytes:
    """The CDR bytes of a message, with their four-byte header."""
    require_message_class(type(message))
    return serialize(message)


def deserialize_message(serialized_message: bytes, message_type: Any) -> Any:
    """The message of a class that CDR bytes hold."""
    require_message_class(message_type)
    return deserialize(serialized_message, message_type)


def require_message_class(cls: Any) -> None:
    """Raise NoTypeSupportImportedException for what is no class of messages."""
    if not isinstance(cls, type) or not hasattr(cls, "__msgtype__") or hasattr(cls, "Request"):
        raise NoTypeSupportImportedException()
