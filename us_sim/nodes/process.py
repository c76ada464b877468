"""One node as one process: started, spun and ended as ROS 2 tools expect."""

from __future__ import annotations

import contextlib
import gc
import inspect
import os
import signal
import sys
import threading
from collections.abc import Callable, Collection
from functools import partial
from typing import Any

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import Executor, ExternalShutdownException
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from us_sim.errors import UsSimError
from us_sim.nodes import INTERRUPTED, announce_often, explain_ros_error
from us_sim.nodes.guarded_node import GuardedNode

COMPUTING, MEASURING = 1, 2
"""Realtime priorities of nodes. Those that hand on measurements take a millisecond, and go before
those that compute for tens; drivers of devices may go before both."""


def raise_priority(priority: int = COMPUTING) -> str:
    """Let all present threads of this process go before ordinary ones, and none that they start.

    Returns:
        ``realtime``, or ``ordinary`` if that is not allowed.
    """
    tried = range(priority, 0, -1) if hasattr(os, "sched_setscheduler") else ()
    able = any(_schedule(each) for each in tried)
    return "realtime" if able else "ordinary"


def raise_receiver_priority() -> None:
    """Let the middleware's threads, not Python's, of this process go before ordinary programs.

    So they acknowledge messages in time, and publishers do not overwrite those.
    """
    if hasattr(os, "sched_setscheduler"):
        _schedule(MEASURING, {thread.native_id for thread in threading.enumerate()})


def _schedule(priority: int, but: Collection[int | None] = ()) -> bool:
    policy = os.SCHED_RR | getattr(os, "SCHED_RESET_ON_FORK", 0)
    try:
        for thread in os.listdir("/proc/self/task"):
            if int(thread) in but:
                continue
            with contextlib.suppress(ProcessLookupError):  # it has just ended
                os.sched_setscheduler(int(thread), policy, os.sched_param(priority))
    except OSError:
        return False
    return True


TURN_S = 0.1
"""Longest turn of the executor: Python's handlers of signals run between turns, and without a limit
the events executor would wait in a busy loop."""

_ENDINGS = (signal.SIGINT, signal.SIGTERM)

_told_to_end = threading.Event()
"""Set by signals: a handler's exception is lost in a destructor or in a compiler's callback."""

signals_wait = threading.Event()
"""Once it is set, a signal waits for the callback's end, so that no message is left halfway."""


def run_node(create: Callable[[], Node], args: list[str] | None = None) -> int:
    """Make and spin a node until it is done or told to stop; return the exit status.

    A node with a ``finished`` future ends when that is done. If it is told to end before, or while
    it is made, the status is `INTERRUPTED`: its work is not done. Bad input, also as the exception
    of that future, is one sentence on stderr and exit status 1.
    """
    announce_often()
    for number in _ENDINGS:
        signal.signal(number, _interrupt_once)
    try:
        # rclpy's own handlers shut the context down from a thread, before ours has run: that could
        # then break off the very end of a node, and leave a recording without its index.
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    except KeyboardInterrupt:
        return INTERRUPTED
    except Exception as error:  # what rcl raises for bad arguments differs between its versions
        return _refuse(explain_ros_error(error))
    return _make_and_spin(create)


def _make_and_spin(create: Callable[[], Node]) -> int:
    """Make and spin a node, destroy it and shut rclpy down; return the exit status."""
    node: Any = None
    try:
        node = create()
        gc.freeze()  # what a node is made of stays; to look through it takes a tenth of a second
        gc.enable()
        inspect.getframeinfo(sys._getframe())  # as rclpy does with each log; the first takes 40 ms
        signals_wait.set()
        executor = create_executor(node)
        if priority := getattr(node, "realtime_priority", 0):
            node.health.scheduling = raise_priority(priority)
        spin(node, executor)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (UsSimError, ParameterException) as error:
        return _refuse(error)
    except MemoryError:
        return _refuse(UsSimError("there is not enough memory"))
    except Exception:
        if rclpy.ok():  # a compiler that a signal breaks off fails with its own error
            raise
    finally:
        for number in _ENDINGS:
            signal.signal(number, signal.SIG_IGN)  # a late one would spoil the exit status
        if node is not None:
            node.destroy_node()
        with contextlib.suppress(Exception):  # rclpy's signal thread may be doing the same
            rclpy.try_shutdown()
    finished = getattr(node, "finished", None)
    if node is None or (finished is not None and not finished.done()):
        return INTERRUPTED
    problem = finished.exception() if finished is not None else None
    return _refuse(problem) if problem is not None else 0


def node_main(create: Callable[[], Node], module: str) -> Callable[..., int]:
    """Return the function that runs a node; if ``module`` is ``__main__``, run it and exit."""
    run = partial(run_node, create)
    if module == "__main__":
        sys.exit(run())
    return run


def create_executor(node: Node) -> Executor:
    """Create the executor that the node asks for, and add the node."""
    executor: Executor = getattr(node, "executor_class", EventsExecutor)(context=node.context)
    # EventsExecutor calls a timer that is overdue when it is added once for each timer that follows
    # it, and each call sets the next one a period later: a slow start made a node silent for 5 s.
    for timer in node.timers:
        if not timer.is_canceled():
            timer.reset()
    executor.add_node(node)
    return executor


def spin(node: Node, executor: Executor) -> None:
    """Run the node's callbacks until its future ``finished``, if any, is done, or it shall end.

    Callbacks of a `GuardedNode` raise nothing. What rclpy raises, for instance for a request of a
    service that it cannot decode, is a failure of the node, too, unless it was shut down.
    """
    finished = getattr(node, "finished", None)
    try:
        while node.context.ok() and (finished is None or not finished.done()):
            if _told_to_end.is_set():
                return
            try:
                executor.spin_once(timeout_sec=TURN_S)
            except ExternalShutdownException:
                raise
            except Exception as error:
                if not isinstance(node, GuardedNode) or not node.context.ok():
                    raise
                node.report_failure("what came in", error)
    finally:
        executor.remove_node(node)


def _interrupt_once(*_: object) -> None:
    """End the node; ignore a second signal, such as launch's after the terminal's."""
    for number in _ENDINGS:
        signal.signal(number, lambda *_: None)
    _told_to_end.set()
    if signals_wait.is_set():
        return
    sys.unraisablehook = lambda _: None  # a compiler's callback has nobody to pass this on to
    raise KeyboardInterrupt


def _refuse(error: Exception) -> int:
    print(f"us_sim: {' '.join(str(error).split())}", file=sys.stderr, flush=True)
    return 1
