"""Refuse an expanded topic or service name that ROS does not allow."""

from typing import Literal

from ._names import error_in_full_topic_name
from .exceptions import InvalidServiceNameException, InvalidTopicNameException

__all__ = ["validate_full_topic_name"]


def validate_full_topic_name(name: str, *, is_service: bool = False) -> Literal[True]:
    """Return True, or raise InvalidTopicNameException or InvalidServiceNameException."""
    if error := error_in_full_topic_name(name):
        raise (InvalidServiceNameException if is_service else InvalidTopicNameException)(
            name, *error
        )
    return True
