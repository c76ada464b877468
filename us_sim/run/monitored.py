"""The monitor in the process that runs a simulation, of which there is one on a ROS domain."""

from __future__ import annotations

import contextlib
import os
import socket
import struct
import sys
import tempfile
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from filelock import FileLock, Timeout

from us_sim.errors import UsSimError
from us_sim.nodes import ros_refusal
from us_sim.run.plan import NodeProcess, enclave_of
from us_sim.run.ros_arguments import namespace, ros_arguments

if TYPE_CHECKING:
    from rclpy.context import Context

    from us_sim.nodes.session_control import Controlled, SessionControl
    from us_sim.nodes.session_monitor import SessionMonitor
    from us_sim.nodes.settings import SessionControlSettings


def domain() -> str:
    """The ROS domain's number, as the environment says it."""
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
    with _abstract_socket(names) if sys.platform == "linux" else _file(names):
        yield


@contextlib.contextmanager
def _abstract_socket(names: str) -> Iterator[None]:
    """A name in the network's own namespace: all users share it, and it goes with its process."""
    name = f"\0us_sim/domain/{names}"
    with socket.socket(socket.AF_UNIX) as held:
        try:
            held.bind(name)
        except OSError as error:
            raise _taken(f" (process {process})" if (process := _holder(name)) else "") from error
        held.listen()
        yield


def _holder(name: str) -> int | None:
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX) as other:
        other.settimeout(1.0)
        other.connect(name)
        credentials = other.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12)
        return int(struct.unpack("3i", credentials)[0]) or None
    return None


@contextlib.contextmanager
def _file(names: str) -> Iterator[None]:
    """Where there are no such names; only among the simulations of one user."""
    lock = FileLock(Path(tempfile.gettempdir()) / f"us_sim_domain_{names}.lock")
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        raise _taken("") from error
    try:
        yield
    finally:
        lock.release()


def _taken(by: str) -> UsSimError:
    return UsSimError(
        f"another simulation{by} runs already on ROS domain {domain()} of this host: end it, or "
        f"set ROS_DOMAIN_ID to another number for this one, or give it a namespace of its own "
        f"(--ros-args -r __ns:=/left)"
    )


def ros_context(number: int | None = None) -> Context:
    """A context that handles no signals.

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
ANSWER_S = 5.0  # for a node to say which parameters it has


class Monitored:
    """A monitor node in this process, with its own context and executor.

    Args:
        nodes: that are followed.
        supervised: they are a simulation, of which there is one on a domain.
        namespace: theirs.
    """

    def __init__(self, nodes: list[str], *, supervised: bool = False, namespace: str = "") -> None:
        from rclpy.executors import SingleThreadedExecutor

        from us_sim.nodes.session_monitor import SessionMonitor

        self._context = ros_context()
        # The first part decides which of two simulations goes on: that which began first.
        self.run = (
            f"{time.time_ns():020} {socket.gethostname()} {os.getpid()}" if supervised else ""
        )
        self.node: SessionMonitor = SessionMonitor(
            nodes, self.run, context=self._context, namespace=namespace
        )
        self._executor: Any = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._namespace = namespace
        self._control: SessionControl | None = None

    def control(self, controlled: Controlled, settings: SessionControlSettings) -> SessionControl:
        """Make the node by which a simulation with these settings is controlled."""
        from us_sim.nodes.session_control import SessionControl

        self._control = SessionControl(
            controlled, settings, context=self._context, namespace=self._namespace
        )
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

    def refuse_earlier_run(self) -> None:
        """Raise UsSimError when another simulation on the network began just before this one."""
        first = min(self.node.other_runs, default=self.run)
        if first < self.run:
            host = first.split(" ")[1:2]
            raise UsSimError(
                f"another simulation{' on ' + host[0] if host else ''} began on ROS domain "
                f"{domain()} just before this one: end it, or set ROS_DOMAIN_ID to another number "
                f"for this one"
            )

    def waiting(self, pids: Mapping[str, int]) -> list[str]:
        """The nodes whose processes have not reported yet."""
        return [node for node, pid in pids.items() if (node, pid) not in self.node.heard]

    def refuse_unknown(self, processes: Sequence[NodeProcess]) -> None:
        """Raise UsSimError when a parameter was given that its node does not have."""
        from rclpy.parameter_client import AsyncParameterClient

        for process in processes:
            if not process.given:
                continue
            client = AsyncParameterClient(self.node, process.node)
            client.wait_for_services(timeout_sec=ANSWER_S)
            answer = client.list_parameters()
            self._executor.spin_until_future_complete(answer, timeout_sec=ANSWER_S)
            if answer.done():
                refuse_unknown(process, answer.result().result.names)

    def close(self) -> None:
        """Leave the domain."""
        self._executor.shutdown()
        if self._control is not None:
            self._control.destroy_node()
        self.node.destroy_node()
        self._context.try_shutdown()


def refuse_unknown(process: NodeProcess, known: Collection[str]) -> None:
    """Raise UsSimError when a parameter was given by a name that is not among the ``known``."""
    for name in process.given:
        if name not in known and not name.startswith("qos_overrides."):
            own = sorted(n for n in known if not n.startswith("qos_overrides."))
            raise UsSimError(
                f"--param {process.node}.{name}: {process.node} has no such parameter; it has "
                f"{', '.join(own)}"
            )
