"""Messages to bytes and back."""

from typing import Any

from ._type_support import require_message_class

__all__ = ["deserialize_message", "serialize_message"]


def serialize_message(message: Any) -> bytes:
    """The CDR bytes of a message, with their four-byte header."""
    from ..messages import serialize

    require_message_class(type(message))
    return serialize(message)


def deserialize_message(serialized_message: bytes, message_type: Any) -> Any:
    """The message of a class that CDR bytes hold."""
    from ..messages import deserialize

    require_message_class(message_type)
    return deserialize(serialized_message, message_type)
