"""One node as one process: started, spun and ended as ROS 2 tools expect."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from types import FrameType
from typing import Any

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from us_sim.errors import UsSimError

__all__ = ["run_node"]


def run_node(create: Callable[[], Node], args: list[str] | None = None) -> int:
    """Spin the node until it is done or told to stop; the exit status.

    A node with a ``finished`` future ends when that is done. Bad input is one sentence on stderr
    and exit status 1.
    """
    signal.signal(signal.SIGINT, _interrupt_once)
    try:
        rclpy.init(args=args)
    except Exception as error:  # what rcl raises for bad arguments differs between its versions
        return _refused(error)
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
    except (UsSimError, ParameterException) as error:
        return _refused(error)
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # a late one would spoil the exit status
    return 0


def _interrupt_once(number: int, frame: FrameType | None) -> None:  # noqa: ARG001
    """Ctrl-C; a second one, such as launch's after the terminal's, must not break off the end."""
    signal.signal(signal.SIGINT, lambda *_: None)
    raise KeyboardInterrupt


def _refused(error: Exception) -> int:
    """One sentence on stderr; the exit status for bad input."""
    print(f"us_sim: {' '.join(str(error).split())}", file=sys.stderr, flush=True)
    return 1
