"""Refuse a node name that ROS does not allow."""

from typing import Literal

from ._names import error_in_node_name
from .exceptions import InvalidNodeNameException

__all__ = ["validate_node_name"]


def validate_node_name(node_name: str) -> Literal[True]:
    """Return True, or raise InvalidNodeNameException."""
    if error := error_in_node_name(node_name):
        raise InvalidNodeNameException(node_name, *error)
    return True
