"""All nodes of a scene in this process, each with a thread; a program, which SIGTERM ends.

Its argument is JSON: a list of the nodes' names with their parameters.
"""

from __future__ import annotations

import contextlib
import json
import signal
import sys
import threading
from typing import Any

from us_sim.run.lockstep import node_in_process


def main(arguments: list[str]) -> int:
    """Run the nodes until SIGTERM."""
    import us_sim.nodes  # noqa: F401, I001 - provides rclpy where ROS 2 is not installed
    import rclpy

    ended = threading.Event()
    rclpy.init(args=[])
    signal.signal(signal.SIGTERM, lambda *_: ended.set())
    context = rclpy.get_default_context()
    wanted = json.loads(arguments[0])
    nodes = [node_in_process(name, parameters, context) for name, parameters in wanted]
    threads = [threading.Thread(target=_spin, args=(node,), daemon=True) for node in nodes]
    for thread in threads:
        thread.start()
    ended.wait()
    rclpy.try_shutdown()
    for thread in threads:
        thread.join(timeout=2.0)
    for node in reversed(nodes):
        node.destroy_node()
    return 0


def _spin(node: Any) -> None:
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor

    executor = SingleThreadedExecutor()
    executor.add_node(node)
    with contextlib.suppress(ExternalShutdownException):
        executor.spin()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
