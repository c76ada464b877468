"""Parameters that are given at the start and stay."""

from __future__ import annotations

from typing import Any

from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rclpy.node import Node

__all__ = ["fixed_parameter"]


def fixed_parameter(
    node: Node,
    name: str,
    value: Any,
    description: str,
    *,
    within: tuple[float, float] | None = None,
) -> Any:
    """Declare a read-only parameter; its value, from the command line or the default ``value``."""
    descriptor = ParameterDescriptor(description=description, read_only=True)
    if within is not None:
        low, high = within
        descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    return node.declare_parameter(name, value, descriptor).value
