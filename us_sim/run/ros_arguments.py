"""The arguments after ``--ros-args`` of the command line of `us-sim`, for all nodes that it starts.

>>> from us_sim.run.ros_arguments import keeping_ros_arguments, namespace, ros_arguments
>>> with keeping_ros_arguments(["run", "arm", "--ros-args", "-r", "__ns:=/a", "--", "-x"]) as rest:
...     print(rest, ros_arguments(), namespace())
['run', 'arm', '-x'] ['-r', '__ns:=/a'] /a
>>> ros_arguments(), namespace()
([], '/')
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator, Sequence

from us_sim.errors import UsSimError

BEGIN, END = "--ros-args", "--"
_KEPT = "US_SIM_ROS_ARGUMENTS"  # in the environment, as JSON


@contextlib.contextmanager
def keeping_ros_arguments(args: Sequence[str]) -> Iterator[list[str]]:
    """Keep those among the arguments for as long as the command runs; gives the others.

    Raises:
        UsSimError: they would give all nodes the same name.
    """
    own, ros = list(args), []
    while BEGIN in own:
        first = own.index(BEGIN)
        last = own.index(END, first) if END in own[first:] else len(own)
        ros += own[first + 1 : last]
        own[first : last + 1] = []
    for each in ros:
        if each.startswith(("__node:=", "__name:=")):
            raise UsSimError(f"{each}: would give all nodes one name: write NODE:{each}")
    before = os.environ.get(_KEPT)
    if ros:
        os.environ[_KEPT] = json.dumps(ros)
    try:
        yield own
    finally:
        if before is None:
            os.environ.pop(_KEPT, None)
        else:
            os.environ[_KEPT] = before


def ros_arguments() -> list[str]:
    """Those of the command that runs, without ``--ros-args``."""
    arguments: list[str] = json.loads(os.environ.get(_KEPT, "[]"))
    return arguments


def namespace() -> str:
    """The namespace that they put nodes in: the first counts, as in rcl."""
    rule = "__ns:="
    return next((a.removeprefix(rule) for a in ros_arguments() if a.startswith(rule)), "/")
