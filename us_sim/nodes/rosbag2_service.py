"""Services of rosbag2, where its interfaces are installed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node


def offer_service(node: Node, service: str, name: str, act: Callable[[Any, Any], Any]) -> bool:
    """Offer a service as a node of rosbag2 does; False where its type is not known here.

    Args:
        node: that offers it.
        service: its type in ``rosbag2_interfaces``, without the package.
        name: below the node's own.
        act: does what the request asks for, and fills the response.
    """
    try:
        from rosbag2_interfaces import srv
    except ImportError:
        return False

    def answer(request: Any, response: Any) -> Any:
        act(request, response)
        return response

    if not hasattr(srv, service):
        return False
    node.create_service(getattr(srv, service), f"~/{name}", answer)
    return True
