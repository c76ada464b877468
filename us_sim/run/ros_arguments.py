"""The arguments after ``--ros-args`` of the command line of `us-sim`, for all nodes that it starts.

>>> from us_sim.run.ros_arguments import namespace, ros_arguments, take_ros_arguments
>>> take_ros_arguments(["run", "arm", "--ros-args", "-r", "__ns:=/a", "--", "-x"])
['run', 'arm', '-x']
>>> ros_arguments(), namespace()
(['-r', '__ns:=/a'], '/a')
>>> take_ros_arguments([]), ros_arguments(), namespace()
([], [], '/')
"""

from __future__ import annotations

from collections.abc import Sequence

from us_sim.errors import UsSimError

BEGIN, END = "--ros-args", "--"
_taken: list[str] = []


def take_ros_arguments(args: Sequence[str]) -> list[str]:
    """Keep those among the arguments of a command; return the others.

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


def ros_arguments() -> list[str]:
    """Return those of the command that runs, without ``--ros-args``."""
    return [*_taken]


def namespace() -> str:
    """Return the namespace that they put nodes in: the first counts, as in rcl."""
    rule = "__ns:="
    return next((a.removeprefix(rule) for a in _taken if a.startswith(rule)), "/")
