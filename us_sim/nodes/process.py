"""One node as one process: started, spun and ended as ROS 2 tools expect."""

from __future__ import annotations

import contextlib
import signal
import sys
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from us_sim.errors import UsSimError

__all__ = ["run_node"]

_ENDINGS = (signal.SIGINT, signal.SIGTERM)


def run_node(create: Callable[[], Node], args: list[str] | None = None) -> int:
    """Spin the node until it is done or told to stop; the exit status.

    A node with a ``finished`` future ends when that is done. Bad input is one sentence on stderr
    and exit status 1.
    """
    for number in _ENDINGS:
        signal.signal(number, _interrupt_once)
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
    except Exception:
        if rclpy.ok():
            raise
        return 0  # a compiler, say, that a signal breaks off fails with an error of its own
    finally:
        if node is not None:
            node.destroy_node()
        with contextlib.suppress(Exception):  # rclpy's signal thread may be doing the same
            rclpy.try_shutdown()
        for number in _ENDINGS:
            signal.signal(number, signal.SIG_IGN)  # a late one would spoil the exit status
    return 0


def _interrupt_once(*_: object) -> None:
    """End the node; a second signal, such as launch's after the terminal's, must not disturb it."""
    for number in _ENDINGS:
        signal.signal(number, lambda *_: None)
    sys.unraisablehook = lambda _: None  # a compiler's callback has nobody to pass this on to
    raise KeyboardInterrupt


def _refused(error: Exception) -> int:
    """One sentence on stderr; the exit status for bad input."""
    print(f"us_sim: {' '.join(str(error).split())}", file=sys.stderr, flush=True)
    return 1
