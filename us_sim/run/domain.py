"""The ROS domain that `us-sim` runs on: its arguments, its context, and one simulation on it."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from us_sim.errors import UsSimError

if TYPE_CHECKING:
    from rclpy.context import Context

BEGIN, END = "--ros-args", "--"
_taken: list[str] = []


def take_ros_arguments(args: Sequence[str]) -> list[str]:
    """Keep a command's arguments after ``--ros-args``, for all nodes; return the others.

    Raises:
        UsSimError: they would give all nodes the same name.
    """
    own = list(args)
    _taken.clear()
    while BEGIN in own:
        first = own.index(BEGIN)
        last = own.index(END, first) if END in own[first:] else len(own)
        _taken.extend(own[first + 1 : last])
        own[first : last + 1] = []
    for each in _taken:
        if each.startswith(("__node:=", "__name:=")):
            raise UsSimError(f"{each}: would give all nodes one name: write NODE:{each}")
    return own


def get_ros_arguments() -> list[str]:
    """Return those of the command that runs, without ``--ros-args``."""
    return [*_taken]


def get_namespace() -> str:
    """Return the namespace that they put nodes in: the first counts, as in rcl."""
    rule = "__ns:="
    return next((a.removeprefix(rule) for a in _taken if a.startswith(rule)), "/")


def get_domain() -> str:
    """Return the ROS domain's number, as the environment says it."""
    return os.environ.get("ROS_DOMAIN_ID") or "0"


def name_enclave(node: str) -> str:
    """Return the place where ROS 2's security finds a node's keys."""
    return f"/us_sim/{node}"


@contextlib.contextmanager
def lock_domain(space: str | None = None) -> Iterator[None]:
    """Have the domain to oneself, in a namespace (that of ``--ros-args``) and on this host.

    Raises:
        UsSimError: another simulation has it.
    """
    from filelock import FileLock, Timeout

    names = ".".join([get_domain(), *filter(None, (space or get_namespace()).split("/"))])
    file = Path(tempfile.gettempdir()) / f"us_sim_domain_{names}.lock"
    try:
        with FileLock(file, timeout=0, mode=0o666):  # of all users of this host
            yield
    except Timeout:
        raise UsSimError(
            f"another simulation runs already on ROS domain {get_domain()} of this host ({file} is "
            f"locked): end it, or set ROS_DOMAIN_ID to another number for this one, or give it a "
            f"namespace of its own (--ros-args -r __ns:=/left)"
        ) from None


def make_ros_context(number: int | None = None) -> Context:
    """Return a context that handles no signals, on the domain of this number or the environment's.

    Raises:
        UsSimError: ROS cannot be used.
    """
    import rclpy
    from rclpy.context import Context
    from rclpy.signals import SignalHandlerOptions

    from us_sim.nodes import announce_often, explain_ros_error

    announce_often()
    context, silent = Context(), SignalHandlerOptions.NO
    given = [BEGIN, "--enclave", name_enclave("session_control"), *get_ros_arguments()]
    try:
        rclpy.init(args=given, context=context, domain_id=number, signal_handler_options=silent)
    except Exception as error:  # what rcl raises differs between its versions
        raise explain_ros_error(error) from error
    return context
