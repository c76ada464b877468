"""Refuse a namespace that ROS does not allow."""

from typing import Literal

from ._names import error_in_namespace
from .exceptions import InvalidNamespaceException

__all__ = ["validate_namespace"]


def validate_namespace(namespace: str) -> Literal[True]:
    """Return True, or raise InvalidNamespaceException."""
    if error := error_in_namespace(namespace):
        raise InvalidNamespaceException(namespace, *error)
    return True
