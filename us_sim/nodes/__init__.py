"""The rclpy nodes; tables of topics and parameters can be read without rclpy.

Importing this package in a node's process ends it silently on Ctrl-C, since an import that is
broken off prints pages of traceback. `us_sim.nodes.process.run_node` takes over once it runs.
"""

from __future__ import annotations

import contextlib
import gc
import importlib.util
import itertools
import os
import re
import signal
import sys
from pathlib import Path

from us_sim.errors import UsSimError
from us_sim.share import shared_path

# Before NumPy loads its BLAS: several node processes share few cores, and small dense solves are
# far slower on many threads.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

INTERRUPTED = 130  # the exit status of a node that was told to end before its work was done


def require_rclpy() -> None:
    """Require one rclpy of one ROS 2 and of this Python, without importing it.

    rclpy's wheels start the interpreter again with their libraries on LD_LIBRARY_PATH, in any order
    with those of a sourced ROS 2, and not if a parent process has done so already.
    """
    found = importlib.util.find_spec("rclpy")
    if found is None or found.origin is None:
        raise UsSimError(
            "rclpy is not installed: on Linux x86-64 `pip install .` brings it; elsewhere use "
            "`pixi run sim` (RoboStack), the Dockerfile, or ROS 2's own packages"
        )
    path = map(Path, os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep))
    loaded = {each.resolve() for each in path if each.match("ros_*.libs")}
    sourced = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)[-1]
    if sourced and loaded:
        raise UsSimError(
            f"two ROS 2 would be mixed, {sourced} and that of pip in {sys.prefix}: start in a "
            f"shell in which none is sourced, or `pip install .` in this shell into a new "
            f"environment, which then has no other"
        )
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    of = re.search(r"/python(3\.\d+)/", found.origin)
    if of is not None and of[1] != version:
        raise UsSimError(
            f"{found.origin} is of Python {of[1]}, and this is {version}: use that Python, or "
            f"install and start us_sim in a shell in which no ROS 2 is sourced"
        )
    own = {each.resolve() for each in Path(found.origin).parents[1].glob("ros_*.libs")}
    if own != loaded:
        raise UsSimError(
            f"the libraries of {found.origin} are not those of LD_LIBRARY_PATH, since the Python "
            f"of another environment started this one: start it without the variables "
            f"_ROS_WHEELS_BOOTSTRAP_COMPLETE and LD_LIBRARY_PATH"
        )


def announce_often() -> None:
    """Have Fast DDS announce nodes twice a second, not every 3 s, unless a profile is set."""
    profile = shared_path("config/fast_dds.xml")
    os.environ.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", str(profile))


def explain_ros_error(error: Exception) -> UsSimError:
    """Return an error of rcl as one sentence, with what a secured domain needs."""
    sentence = f"ROS cannot be used: {' '.join(str(error).split())}"
    if os.environ.get("ROS_SECURITY_ENABLE") == "true":
        sentence += (
            "; ROS_SECURITY_ENABLE is true: each node needs its keys in ROS_SECURITY_KEYSTORE, "
            "and a DDS that was built with security"
        )
    return UsSimError(sentence)


def prepare_process(name: str) -> None:
    """Give the process the node's name, require rclpy, and have Ctrl-C end it at once."""
    with contextlib.suppress(ImportError):  # a node works without a name in `ps`
        from setproctitle import setproctitle

        setproctitle(name)
    gc.disable()  # until the node is made, which leaves little garbage
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, lambda *_: os._exit(INTERRUPTED))
    try:
        require_rclpy()
    except UsSimError as error:
        sys.exit(f"us_sim: {error}")


def node_name(command: list[str]) -> str:
    """Return the node that a command line runs as a module or by colcon's script, or nothing.

    >>> node_name(["python3", "-X", "dev", "-m", "us_sim.nodes.path_player", "--ros-args"])
    'path_player'
    >>> node_name(["/usr/bin/python3", "/ws/install/us_sim/lib/us_sim/path_player"])
    'path_player'
    >>> node_name(["python3", "-m", "pytest", "tests/nodes"]), node_name(["python3", "script.py"])
    ('', '')
    """
    for option, value in itertools.pairwise(command):
        if option == "-m":
            is_own = value.startswith((f"{__name__}.", "us_sim.viewer.viewer"))
            return value.rpartition(".")[2] if is_own else ""
        if not value.startswith("-") and option not in ("-X", "-W"):  # which a value follows
            name = Path(value).name
            is_own = name.isidentifier() and (Path(__file__).parent / f"{name}.py").is_file()
            return name if is_own or name == "viewer" else ""
    return ""


if _name := node_name(sys.orig_argv):  # this process is a node
    prepare_process(_name)  # before the imports that take a second
