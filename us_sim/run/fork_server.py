"""One process from which nodes are forked, so that what all of them import is imported once.

`us_sim.run.forking` starts it and asks it for nodes. It imports what every node needs, then what
those need that compute, and forks a node whenever one is asked for. A node that is forked is a
child of the process that asked, as one that is started as a program is: the process between them
ends at once, and the one that asked adopts its orphans (PR_SET_CHILD_SUBREAPER).

A process with several threads cannot be forked safely. Where what is imported starts a thread, this
one ends, and nodes are started as programs. On other systems than Linux they always are.
"""

from __future__ import annotations

import gc
import importlib
import json
import os
import runpy
import select
import socket
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from us_sim.run.end_with_parent import end_with_parent

EVERY_NODE = ("us_sim.nodes", "us_sim.nodes.process", "us_sim.nodes.scene_node")
"""What every node imports; the first provides rclpy."""
COMPUTING = ("us_sim.kernels", "scipy.sparse", "scipy.sparse.linalg", "scipy.sparse.csgraph")
"""What the nodes import that compute with kernels."""
COMPUTING_NODES = ("tissue_deformer", "slice_interpolator", "skin_deformer")
LONGEST = 1 << 18
"""Bytes of a request."""
ADOPTED_S = 5.0
"""How long a node may take to become a child of the process that asked."""


@dataclass(frozen=True)
class _Request:
    """A node that is asked for."""

    node: str
    command: list[str]  # the command line that it would be started with
    environment: dict[str, str]
    parent: int  # pid of the process that asks
    files: list[int]  # descriptors: its input, its output, and where it says that it is there


def main() -> int:
    """Fork nodes until the other side of the socket on stdin is closed; the exit status.

    In a node's process it runs that node.
    """
    request = _serve(socket.socket(fileno=os.dup(0)))
    if request is None:
        return 0
    module = request.command[request.command.index("-m") + 1]
    runpy.run_module(module, run_name="__main__", alter_sys=True)
    return 0


def _serve(control: socket.socket) -> _Request | None:
    """In this process None, once nobody asks any more; in a node's process what was asked for."""
    waiting = [*EVERY_NODE, *COMPUTING]
    while True:
        if len(waiting) > len(COMPUTING) or (waiting and not _is_readable(control)):
            _import(waiting)
            continue
        request = _received(control)
        if request is None or len(os.listdir("/proc/self/task")) > 1:
            return None
        while waiting and request.node in COMPUTING_NODES:
            _import(waiting)
        if _forked(request):
            control.close()
            return request
        for file in request.files:
            os.close(file)


def _import(waiting: list[str]) -> None:
    """The next module; after the last, all that is imported is made ready to be forked."""
    importlib.import_module(waiting.pop(0))
    if not waiting:
        from us_sim.kernels import warm_up

        warm_up()
        gc.collect()
        gc.freeze()  # what is collected later is copied for every node that looks at it


def _is_readable(control: socket.socket) -> bool:
    return bool(select.select([control], [], [], 0.0)[0])


def _received(control: socket.socket) -> _Request | None:
    """The next request; None when there will be none."""
    data, files, _, _ = socket.recv_fds(control, LONGEST, 3)
    if not data:
        return None
    asked = json.loads(data)
    return _Request(**asked, files=files)


def _forked(request: _Request) -> bool:
    """Fork the node; whether this is its process, and ready to be it."""
    between = os.fork()
    if between:
        os.waitpid(between, 0)
        return False
    own = os.getpid()
    if os.fork():
        os._exit(0)
    try:
        _become(request, own)
    except BaseException:
        os._exit(1)
    return True


def _become(request: _Request, between: int) -> None:
    """Make of this process what a program of its own would be."""
    from us_sim.nodes.early_interrupt import end_at_once_when_interrupted

    given, said, ready = request.files
    until = time.monotonic() + ADOPTED_S
    while os.getppid() == between and time.monotonic() < until:
        time.sleep(0.0002)
    os.setsid()
    end_with_parent()
    if os.getppid() != request.parent:
        raise ChildProcessError("the process that asked has ended, or does not adopt it")
    os.dup2(given, 0)
    os.dup2(said, 1)
    os.dup2(said, 2)
    os.environ.update(request.environment)
    sys.orig_argv = request.command
    end_at_once_when_interrupted()
    program = Path(__file__).parents[1] / "nodes" / f"{request.node}.py"
    sys.argv = [str(program), *request.command[request.command.index("--ros-args") :]]
    _show_command(request.command)
    os.write(ready, str(os.getpid()).encode())
    for file in request.files:
        os.close(file)


def _show_command(words: list[str]) -> None:
    """Let tools such as ps show the node's command line, as far as there is room for it."""
    import ctypes

    fields = Path("/proc/self/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    start, end = int(fields[45]), int(fields[46])  # arg_start and arg_end, proc_pid_stat(5)
    line = "\0".join(words).encode(errors="surrogateescape")[: max(end - start - 1, 0)]
    ctypes.memmove(start, line.ljust(end - start, b"\0"), end - start)


if __name__ == "__main__":
    sys.exit(main())
