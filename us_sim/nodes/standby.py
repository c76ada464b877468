"""A second process of a node, which waits until it is needed with all that takes time done."""

from __future__ import annotations

import contextlib
import gc
import json
import os
import sys
import threading
from collections.abc import Callable

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

STANDBY = "US_SIM_STANDBY"
"""Set in the environment of a process that is to wait."""
STANDING_BY = "standing by"
"""What it says when it is ready."""

_RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
_NICE = 19


def stand_by(create: Callable[[], Node], args: list[str] | None) -> list[str] | None:
    """Wait for a line on stdin: the arguments to run with, as JSON; None at the end of stdin.

    Meanwhile the node is made once where nobody can discover it, and thrown away: its modules and
    kernels are loaded then. That is done by a thread of low priority, which the nodes that run do
    not notice.
    """
    rehearsal = threading.Thread(target=_rehearse, args=(create, args), daemon=True)
    rehearsal.start()
    rehearsal.join()
    print(STANDING_BY, flush=True)
    line = sys.stdin.readline()
    return list(json.loads(line)) if line else None


def _rehearse(create: Callable[[], Node], args: list[str] | None) -> None:
    with contextlib.suppress(AttributeError, OSError):
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
    before = os.environ.get(_RANGE)
    os.environ[_RANGE] = "OFF"
    # What is wrong with the node is said when it is made in earnest.
    with contextlib.suppress(Exception):
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        create().destroy_node()
    with contextlib.suppress(Exception):
        rclpy.try_shutdown()
    del os.environ[_RANGE]
    if before is not None:
        os.environ[_RANGE] = before
    gc.collect()
