"""One node as one process: started, spun and ended as ROS 2 tools expect."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from us_sim.errors import UsSimError

__all__ = ["run_node"]


def run_node(create: Callable[[], Node], args: list[str] | None = None) -> int:
    """Spin the node until it is done or told to stop; the exit status.

    A node with a ``finished`` future ends when that is done. Bad input is one sentence on stderr
    and exit status 1.
    """
    rclpy.init(args=args)
    node: Any = None
    try:
        node = create()
        finished = getattr(node, "finished", None)
        if finished is None:
            rclpy.spin(node)
        else:
            rclpy.spin_until_future_complete(node, finished)
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    except UsSimError as error:
        print(f"us_sim: {error}", file=sys.stderr, flush=True)
        return 1
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0
