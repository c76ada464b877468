"""Refuse a parameter name that ROS does not allow."""

from typing import Literal

from .exceptions import InvalidParameterException

__all__ = ["validate_parameter_name"]


def validate_parameter_name(name: str) -> Literal[True]:
    """Return True, or raise InvalidParameterException."""
    if not name:
        raise InvalidParameterException(name)
    return True
