"""Ctrl-C while a node's modules are still imported: the process ends without a word.

An import that a KeyboardInterrupt breaks off fails in ways of its own, with pages of traceback, and
there is nothing yet to be closed. `us_sim.nodes.process.run_node` takes over once it runs.
"""

from __future__ import annotations

import itertools
import os
import signal
import sys
from pathlib import Path

_INTERRUPTED = 130
_WITH_VALUE = ("-X", "-W")  # the interpreter's options that are followed by a value


def end_at_once_when_interrupted() -> None:
    """Do so from now on, where this process is a node and was not told to ignore Ctrl-C."""
    if is_node(sys.orig_argv) and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, lambda *_: os._exit(_INTERRUPTED))


def is_node(command: list[str]) -> bool:
    """Whether a command line runs a node: as a module, or by the script that colcon installs.

    >>> is_node(["python3", "-X", "dev", "-m", "us_sim.nodes.path_player", "--ros-args"])
    True
    >>> is_node(["/usr/bin/python3", "/ws/install/us_sim/lib/us_sim/path_player"])
    True
    >>> is_node(["python3", "-m", "pytest", "tests/nodes"]), is_node(["python3", "my_script.py"])
    (False, False)
    """
    package = __name__.rpartition(".")[0]
    for option, value in itertools.pairwise(command):
        if option == "-m":
            return value.startswith(f"{package}.")
        if not value.startswith("-") and option not in _WITH_VALUE:
            name = Path(value).name
            return name.isidentifier() and (Path(__file__).parent / f"{name}.py").is_file()
    return False
