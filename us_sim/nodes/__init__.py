"""The rclpy nodes. Importing this package provides rclpy where ROS 2 is not installed.

It also ends a node's process without a word when Ctrl-C comes while its modules are imported: an
import that a KeyboardInterrupt breaks off fails in ways of its own, with pages of traceback.
`us_sim.nodes.process.run_node` takes over once it runs.
"""

from __future__ import annotations

import itertools
import os
import signal
import sys
from pathlib import Path

# Before NumPy loads its BLAS: several node processes share few cores, and small dense solves are
# far slower on many threads.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

INTERRUPTED = 130  # the exit status of a node that was told to end before its work was done
STANDBY = "US_SIM_STANDBY"  # set in the environment of a node's process that is to wait
STANDING_BY = "standing by"  # said by such a process once it is ready


def end_at_once_when_interrupted() -> None:
    """Do so from now on, where this process is a node and was not told to ignore Ctrl-C."""
    if is_node(sys.orig_argv) and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, lambda *_: os._exit(INTERRUPTED))


def is_node(command: list[str]) -> bool:
    """Whether a command line runs a node: as a module, or by the script that colcon installs.

    >>> is_node(["python3", "-X", "dev", "-m", "us_sim.nodes.path_player", "--ros-args"])
    True
    >>> is_node(["/usr/bin/python3", "/ws/install/us_sim/lib/us_sim/path_player"])
    True
    >>> is_node(["python3", "-m", "pytest", "tests/nodes"]), is_node(["python3", "my_script.py"])
    (False, False)
    """
    for option, value in itertools.pairwise(command):
        if option == "-m":
            return value.startswith((f"{__name__}.", "us_sim.viewer.viewer"))
        if not value.startswith("-") and option not in ("-X", "-W"):  # which a value follows
            name = Path(value).name
            of_package = name.isidentifier() and (Path(__file__).parent / f"{name}.py").is_file()
            return of_package or name == "viewer"
    return False


end_at_once_when_interrupted()  # before the imports that take a second

from us_sim.standalone import install  # noqa: E402

install()
