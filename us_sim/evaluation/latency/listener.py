"""A thread of this process that hears what a running graph publishes."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from us_sim.nodes.arrivals import Arrivals


@contextlib.contextmanager
def listening(*, viewer: bool) -> Iterator[Arrivals]:
    """A node that notes arrivals until the context is left.

    Args:
        viewer: whether it also takes what is made for the eye.
    """
    import us_sim.nodes  # noqa: F401, I001 - provides rclpy where ROS 2 is not installed
    import rclpy
    from rclpy.context import Context
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    from us_sim.nodes.arrivals import Arrivals
    from us_sim.nodes.process import go_along, go_first

    context = Context()
    rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
    node = Arrivals(viewer=viewer, context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)

    def spin() -> None:
        with contextlib.suppress(ExternalShutdownException):
            executor.spin()

    thread = threading.Thread(target=spin, daemon=True)
    thread.start()
    go_first()  # what is measured is the graph's wait for a core, not the listener's
    try:
        yield node
    finally:
        go_along()
        context.try_shutdown()
        thread.join(timeout=5.0)
