"""The monitor in the process that runs a simulation, of which there is one on a ROS domain."""

from __future__ import annotations

import contextlib
import os
import tempfile
import time
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from filelock import FileLock, Timeout

from us_sim.errors import UsSimError
from us_sim.nodes import ros_refusal
from us_sim.run.plan import enclave_of
from us_sim.run.ros_arguments import namespace, ros_arguments

if TYPE_CHECKING:
    from rclpy.context import Context

    from us_sim.nodes.session_control import Controlled, SessionControl
    from us_sim.nodes.session_monitor import SessionMonitor
    from us_sim.nodes.settings import SessionControlSettings


def domain() -> str:
    """Return the ROS domain's number, as the environment says it."""
    return os.environ.get("ROS_DOMAIN_ID") or "0"


@contextlib.contextmanager
def alone_on_domain(space: str | None = None) -> Iterator[None]:
    """Have the domain to oneself, as far as simulations in a namespace and on this host go.

    Args:
        space: the namespace; None is that of ``--ros-args``.

    Raises:
        UsSimError: another simulation has it.
    """
    names = ".".join([domain(), *filter(None, (space or namespace()).split("/"))])
    file = Path(tempfile.gettempdir()) / f"us_sim_domain_{names}.lock"
    lock = FileLock(file, timeout=0, mode=0o666)  # of all users of this host
    try:
        with lock:
            yield
    except Timeout:
        raise UsSimError(
            f"another simulation runs already on ROS domain {domain()} of this host ({file} is "
            f"locked): end it, or set ROS_DOMAIN_ID to another number for this one, or give it a "
            f"namespace of its own (--ros-args -r __ns:=/left)"
        ) from None


def ros_context(number: int | None = None) -> Context:
    """Return a context that handles no signals.

    Args:
        number: of the ROS domain; None is the environment's.

    Raises:
        UsSimError: ROS cannot be used.
    """
    import rclpy
    from rclpy.context import Context
    from rclpy.signals import SignalHandlerOptions

    context, silent = Context(), SignalHandlerOptions.NO
    given = ["--ros-args", "--enclave", enclave_of("session_control"), *ros_arguments()]
    try:
        rclpy.init(args=given, context=context, domain_id=number, signal_handler_options=silent)
    except Exception as error:  # what rcl raises differs between its versions
        raise ros_refusal(error) from error
    return context


DISCOVERY_S = 0.4  # to discover whether another simulation is on this ROS domain


class Monitored:
    """A monitor node in this process, with its own context and executor.

    Args:
        nodes: that are followed.
        namespace: theirs.
    """

    def __init__(self, nodes: list[str], *, namespace: str = "") -> None:
        from rclpy.executors import SingleThreadedExecutor

        from us_sim.nodes.session_monitor import SessionMonitor

        self._context = ros_context()
        self._names: dict[str, Any] = {"context": self._context, "namespace": namespace}
        self.node: SessionMonitor = SessionMonitor(nodes, **self._names)
        self._executor: Any = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._control: SessionControl | None = None

    def control(self, controlled: Controlled, settings: SessionControlSettings) -> SessionControl:
        """Make the node by which a simulation with these settings is controlled."""
        from us_sim.nodes.session_control import SessionControl

        self._control = SessionControl(controlled, settings, **self._names)
        self._executor.add_node(self._control)
        return self._control

    def spin(self, seconds: float = 0.1) -> None:
        """Take the next message, waiting at most so long."""
        self._executor.spin_once(timeout_sec=seconds)

    def refuse_company(self, names: Collection[str]) -> None:
        """Raise UsSimError when a node of one of these names is on the domain already."""
        until = time.monotonic() + DISCOVERY_S
        while time.monotonic() < until:
            self.spin()
        own = self.node.get_namespace()
        there = {name for name, space in self.node.get_node_names_and_namespaces() if space == own}
        if taken := sorted(set(names) & there):
            raise UsSimError(
                f"{taken[0]} runs already on ROS domain {domain()}: "
                f"end that simulation, or set ROS_DOMAIN_ID to another number for this one"
            )

    def close(self) -> None:
        """Leave the domain."""
        self._executor.shutdown()
        if self._control is not None:
            self._control.destroy_node()
        self.node.destroy_node()
        self._context.try_shutdown()
