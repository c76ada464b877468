"""Several nodes in one process, each with an executor in a thread of its own: less memory.

Their messages go through the middleware as between processes, since rclpy has neither
intra-process communication nor loaned messages.
"""

from __future__ import annotations

import contextlib
import importlib
import sys
import threading
from functools import partial
from typing import Any

from rclpy.executors import Executor, ExternalShutdownException
from rclpy.node import Node
from rclpy.task import Future

from us_sim.errors import SettingsError, UsSimError
from us_sim.nodes.guarded_node import GuardedNode, Health
from us_sim.nodes.parameters import declared
from us_sim.nodes.process import COMPUTING, create_executor, run_node, spin
from us_sim.nodes.settings import COMPOSABLE, ComposedSettings
from us_sim.settings.spelling import unknown

END_S = 2.0  # for a node to end what it does


def node_class(name: str) -> Any:
    """The class of a node by the node's name: `ProbeTracker` of ``probe_tracker``."""
    kind = "".join(word.capitalize() for word in name.split("_"))
    return getattr(importlib.import_module(f"us_sim.nodes.{name}"), kind)


class Composed(GuardedNode):
    """Holds the nodes that its parameter ``nodes`` names.

    Their own parameters are given with their names: ``-p probe_tracker:scene:=upper_arm``.

    Raises:
        UsSimError: there is no such node, or what that refuses.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("composed", **kwargs)
        names = declared(self, ComposedSettings()).nodes
        for name in names:
            if name not in COMPOSABLE:
                raise SettingsError(f"composed.nodes: {unknown(name, COMPOSABLE)}")
        self.finished: Future | None = None  # with what a part has failed of
        self.parts = [node_class(name)(context=self.context) for name in names]
        are_realtime = any(getattr(part, "realtime_priority", 0) for part in self.parts)
        self.realtime_priority = COMPUTING if are_realtime else 0
        self.health = Health(self, ", ".join(names))
        self.health.state = "running"
        self._threads = [
            threading.Thread(target=self._run, args=(part, create_executor(part)), daemon=True)
            for part in self.parts
        ]
        for thread in self._threads:
            thread.start()

    def _run(self, part: Node, executor: Executor) -> None:
        try:
            spin(part, executor)
        except ExternalShutdownException:
            pass
        except Exception as error:
            if self.context.ok():
                self.failed(part.get_name(), error)
                self.finished = Future()
                self.finished.set_exception(UsSimError(self.last_failure))
                self.context.try_shutdown()

    def destroy_node(self) -> None:
        """End all of them."""
        with contextlib.suppress(RuntimeError):  # rclpy's signal thread may do the same
            self.context.try_shutdown()
        for thread in getattr(self, "_threads", ()):
            thread.join(END_S)
        for part in reversed(getattr(self, "parts", ())):
            part.destroy_node()
        super().destroy_node()


main = partial(run_node, Composed)


if __name__ == "__main__":
    sys.exit(main())
