"""Whether a class is one of a message or a service."""

from typing import Any

from .exceptions import NoTypeSupportImportedException

__all__ = ["require_message_class", "require_service_class"]


def require_message_class(cls: Any) -> None:
    """Raise NoTypeSupportImportedException when a class is no message class."""
    if not isinstance(cls, type) or not hasattr(cls, "__msgtype__") or hasattr(cls, "Request"):
        raise NoTypeSupportImportedException()


def require_service_class(cls: Any) -> None:
    """Raise NoTypeSupportImportedException when a class is no service class."""
    if not isinstance(cls, type) or not hasattr(cls, "Request") or not hasattr(cls, "Response"):
        raise NoTypeSupportImportedException()
