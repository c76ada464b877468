"""The simulator in a process of its own: its messages, processor time and memory.

>>> import os
>>> from us_sim.evaluation.processes import measure_usage
>>> usage = measure_usage(os.getpid())
>>> usage is None or usage["MB"] > 1.0
True
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from us_sim.errors import UsSimError

if TYPE_CHECKING:
    from us_sim.evaluation.latency.arrivals import Arrivals


def measure_usage(pid: int) -> dict[str, float] | None:
    """Measure the usage of a process so far; None if it has ended or there is no /proc.

    Returns:
        ``processor``, s of all its threads, and resident ``MB``; a page that n processes share
        counts 1/n in each of them.
    """
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        sizes = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="utf-8")
        ticks = int(fields[11]) + int(fields[12])
    except (OSError, IndexError):
        return None
    share = re.search(r"^Pss:\s+(\d+) kB", sizes, re.MULTILINE)  # proc(5): proportional set size
    if share is None:  # it has ended, and only its number is left
        return None
    return {"processor": ticks / os.sysconf("SC_CLK_TCK"), "MB": 1.024e-3 * int(share[1])}


class UsageOverTime:
    """Usage of all descendants of a process, added up by name."""

    def __init__(self, parent: int) -> None:
        self._parent, self._began = parent, time.monotonic()
        self._rows: list[dict[str, Any]] = []

    def update(self) -> None:
        """Record the usage of every descendant so far."""
        passed = time.monotonic() - self._began
        for pid, name in find_descendants(self._parent).items():
            if (usage := measure_usage(pid)) is not None:
                self._rows.append({"process": name, "s": passed, **usage})

    def make_table(self) -> pd.DataFrame:
        """Make a row for each name and moment: ``process``, ``s``, ``processor`` (s), ``MB``."""
        rows = pd.DataFrame(self._rows, columns=["process", "s", "processor", "MB"])
        return rows.groupby(["process", "s"], sort=False, as_index=False).sum()

    def make_columns(self) -> dict[str, float]:
        """Return cores, final memory and its growth after the first minute, of every name.

        Growth is by least squares; NaN after less than two minutes.
        """
        found = {}
        for name, rows in self.make_table().groupby("process", sort=False):
            passed = float(rows["s"].max() - rows["s"].min())
            worked = float(rows["processor"].iloc[-1] - rows["processor"].iloc[0])
            late = rows[rows["s"] >= rows["s"].min() + 60.0]
            grown = 60.0 * np.polyfit(late["s"], late["MB"], 1)[0] if passed >= 120.0 else np.nan
            found[f"cores_{name}"] = worked / passed if passed else np.nan
            found[f"memory_mb_{name}"] = float(rows["MB"].iloc[-1])
            found[f"growth_mb_a_minute_{name}"] = float(grown)
        return found


def find_descendants(pid: int) -> dict[int, str]:
    """Find all descendants of a process: names of nodes or programs by process number."""
    found: dict[int, str] = {}
    waiting = [pid]
    while waiting:
        with contextlib.suppress(OSError):
            for task in Path(f"/proc/{waiting.pop()}/task").iterdir():
                for word in (task / "children").read_text(encoding="utf-8").split():
                    found[int(word)] = _read_name(int(word))
                    waiting.append(int(word))
    return found


def _read_name(pid: int) -> str:
    try:
        words = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").split("\0")
    except OSError:
        return "gone"
    return "browser" if "chrom" in words[0] else Path(words[0]).name


@dataclass
class SimulatorProcess:
    """`us-sim` in a process of its own."""

    process: subprocess.Popen[bytes]
    output: IO[bytes]
    began: float

    def read_output(self) -> str:
        """Read the output so far."""
        return Path(self.output.name).read_text(encoding="utf-8", errors="replace")

    def require_running(self) -> None:
        """Raise UsSimError if the simulator has ended."""
        if self.process.poll() is not None:
            lines = self.read_output().strip().splitlines()
            raise UsSimError(f"us-sim has ended{': ' if lines else ''}{''.join(lines[-1:])}")

    def await_image(self, arrivals: Arrivals) -> None:
        """Wait for the first image.

        Raises:
            UsSimError: the simulation has ended, or no image comes.
        """
        while not arrivals.list_arrivals("ultrasound/image"):
            self.require_running()
            if time.monotonic() - self.began > 300.0:  # the first run compiles
                raise UsSimError("no image came in 300 s")
            time.sleep(0.02)


@contextlib.contextmanager
def run_simulator(*arguments: str) -> Iterator[SimulatorProcess]:
    """Run `us-sim` with arguments; interrupt it when the context is left."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(part for part in sys.path if part)}
    with tempfile.NamedTemporaryFile(prefix="us_sim_evaluate_") as output:
        began = time.monotonic()
        process = subprocess.Popen(
            [sys.executable, "-m", "us_sim", *arguments],
            env=environment,
            stdout=output,
            stderr=subprocess.STDOUT,
        )
        try:
            yield SimulatorProcess(process, output, began)
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(20.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


@contextlib.contextmanager
def record_arrivals() -> Iterator[Arrivals]:
    """Record arrivals, in a thread of this process, until the context is left."""
    import rclpy
    from rclpy.context import Context
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    from us_sim.evaluation.latency.arrivals import Arrivals
    from us_sim.nodes.process import raise_priority

    context = Context()
    rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
    node = Arrivals(context=context)

    def spin_node() -> None:
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        with contextlib.suppress(ExternalShutdownException):
            executor.spin()

    thread = threading.Thread(target=spin_node, daemon=True)
    thread.start()
    raise_priority(2)  # so that this thread's wait for a core is not measured
    try:
        yield node
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))
        context.try_shutdown()
        thread.join(timeout=5.0)
