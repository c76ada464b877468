"""Refuse a topic or service name, as a person writes it, that ROS does not allow."""

from typing import Literal

from ._names import error_in_topic_name
from .exceptions import InvalidServiceNameException, InvalidTopicNameException

__all__ = ["TOPIC_SEPARATOR_STRING", "validate_topic_name"]

TOPIC_SEPARATOR_STRING = "/"


def validate_topic_name(name: str, *, is_service: bool = False) -> Literal[True]:
    """Return True, or raise InvalidTopicNameException or InvalidServiceNameException."""
    if error := error_in_topic_name(name):
        raise (InvalidServiceNameException if is_service else InvalidTopicNameException)(
            name, *error
        )
    return True
