"""One simulation on a ROS domain of this host: whoever begins first has it until its process ends.

Discovery cannot tell: two that begin at the same moment do not see each other yet.
"""

from __future__ import annotations

import contextlib
import os
import socket
import struct
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from us_sim.errors import UsSimError


def domain() -> str:
    """The ROS domain's number, as the environment says it."""
    return os.environ.get("ROS_DOMAIN_ID") or "0"


@contextlib.contextmanager
def alone_on_domain(namespace: str = "") -> Iterator[None]:
    """Have the domain to oneself, as far as simulations in this namespace and on this host go.

    Raises:
        UsSimError: another simulation has it.
    """
    names = ".".join([domain(), *filter(None, namespace.split("/"))])
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
    """The process that has the name."""
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
        f"set ROS_DOMAIN_ID to another number for this one"
    )
