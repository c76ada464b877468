"""Momentary commands: services of the type std_srvs/Trigger, for what has no parameter."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from std_srvs.srv import Trigger


def offer(node: Node, name: str, act: Callable[[], str]) -> None:
    """Offer a command as ``~/name``.

    Args:
        node: that obeys.
        name: below the node's own.
        act: does it; why that cannot be, or nothing.
    """

    def answer(_: Any, response: Any) -> Any:
        response.message = act()
        response.success = not response.message
        return response

    node.create_service(Trigger, f"~/{name}", answer)
