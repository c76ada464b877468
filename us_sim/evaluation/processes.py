"""Processes of their own: their processor time and memory, a running graph, an image's message.

``python -m us_sim.evaluation.processes`` runs one of the programs at the end of this file.

>>> import os
>>> from us_sim.evaluation.processes import usage_of
>>> usage = usage_of(os.getpid())
>>> usage is None or usage.memory > 1e6
True
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from us_sim.evaluation.latency.arrivals import Arrivals


def start_program(name: str, *arguments: str) -> subprocess.Popen[str]:
    """Start a program of this module, on this host only; it ends with this process."""
    from us_sim.run.processes import LIFELINE, child_environment

    return subprocess.Popen(
        [sys.executable, "-P", "-m", "us_sim.evaluation.processes", name, *arguments],
        stdin=LIFELINE,
        env={"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", **child_environment()},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )


@dataclass(frozen=True)
class Usage:
    """Resources that a process has used until now."""

    processor: float  # s, of all its threads
    memory: float  # bytes, resident; a page that n processes share counts 1/n in each of them


def usage_of(pid: int) -> Usage | None:
    """Usage of a process; None where it has ended, or the system does not tell."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        sizes = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="utf-8")
        ticks = int(fields[11]) + int(fields[12])
    except (OSError, IndexError):
        return None
    share = re.search(r"^Pss:\s+(\d+) kB", sizes, re.MULTILINE)  # proc(5): proportional set size
    if share is None:  # it has ended, and only its number is left
        return None
    return Usage(ticks / os.sysconf("SC_CLK_TCK"), 1024.0 * int(share[1]))


@dataclass
class UsageOverTime:
    """Usage of one process, or of several of one name, at several times."""

    times: list[float] = field(default_factory=list)  # s
    uses: list[Usage] = field(default_factory=list)

    def add(self, time: float, usage: Usage | None) -> None:
        """Append the usage at a time (s), if it is known."""
        if usage is not None:
            self.times.append(time)
            self.uses.append(usage)

    @property
    def processor(self) -> float:
        """Processor time over time: 1 is one core."""
        if len(self.times) < 2:
            return np.nan
        used = self.uses[-1].processor - self.uses[0].processor
        return used / (self.times[-1] - self.times[0])

    @property
    def memory(self) -> float:
        """Bytes in the end."""
        return self.uses[-1].memory if self.uses else np.nan

    @property
    def growth(self) -> float:
        """Bytes a minute after the first minute, by least squares; NaN in less than two minutes."""
        if not self.times or self.times[-1] - self.times[0] < 120.0:
            return np.nan
        time = np.array(self.times) - self.times[0]
        late = time >= 60.0
        memory = np.array([use.memory for use in self.uses])
        return 60.0 * float(np.polyfit(time[late], memory[late], 1)[0])


class UsageByName:
    """Usage of processes over time, those of one name added up."""

    def __init__(self) -> None:
        self.uses: dict[str, UsageOverTime] = {}
        self._began = time.monotonic()

    def update(self, processes: dict[int, str]) -> None:
        """Add the usage of processes, whose names are given by their numbers."""
        passed = time.monotonic() - self._began
        sums: dict[str, Usage] = {}
        for pid, name in processes.items():
            if (usage := usage_of(pid)) is not None:
                before = sums.get(name, Usage(0.0, 0.0))
                sums[name] = Usage(before.processor + usage.processor, before.memory + usage.memory)
        for name, usage in sums.items():
            self.uses.setdefault(name, UsageOverTime()).add(passed, usage)


def started_by(pid: int) -> dict[int, str]:
    """Names of all descendants of a process by their numbers: of a node, or of a program."""
    found: dict[int, str] = {}
    waiting = [pid]
    while waiting:
        with contextlib.suppress(OSError):
            for task in Path(f"/proc/{waiting.pop()}/task").iterdir():
                for word in (task / "children").read_text(encoding="utf-8").split():
                    found[int(word)] = _name(int(word))
                    waiting.append(int(word))
    return found


def _name(pid: int) -> str:
    try:
        words = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").split("\0")
    except OSError:
        return "gone"
    return "browser" if "chrom" in words[0] else Path(words[0]).name


@contextlib.contextmanager
def listening(*, viewer: bool) -> Iterator[Arrivals]:
    """A node in a thread of this process that notes arrivals until the context is left.

    Args:
        viewer: whether it also takes the annotated image and the structures.
    """
    import rclpy
    from rclpy.context import Context
    from rclpy.signals import SignalHandlerOptions

    from us_sim.evaluation.latency.arrivals import Arrivals
    from us_sim.nodes.process import go_along, go_first

    context = Context()
    rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
    node = Arrivals(viewer=viewer, context=context)
    thread = threading.Thread(target=_spin, args=(node, context), daemon=True)
    thread.start()
    go_first(2)  # the graph's wait for a core is measured, not the listener's for the nodes
    try:
        yield node
    finally:
        go_along()
        context.try_shutdown()
        thread.join(timeout=5.0)


def _spin(node: Any, context: Any) -> None:
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor

    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    with contextlib.suppress(ExternalShutdownException):
        executor.spin()


def peak_memory(side: int) -> int | None:
    """Peak memory, bytes, of a process that cuts a volume of ``side``³ uint8 voxels.

    It includes the volume, Python and every library. None where the system does not tell.
    """
    said, _ = start_program("memory", str(side)).communicate()
    return int(said) if said.strip().isdigit() else None


def publishing_ms(side: int) -> float | None:
    """ms to make and publish a ``side`` × ``side`` image, median at 60 Hz; None where none went."""
    watcher, sender = start_program("watch"), start_program("publish", str(side))
    try:
        return float(sender.communicate(timeout=120.0)[0])
    except (subprocess.TimeoutExpired, ValueError):
        return None
    finally:
        for process in (watcher, sender):
            process.kill()
            process.communicate()


def _run_nodes(nodes: str) -> None:
    """Run nodes, a JSON list of their names and parameters, each in a thread, until SIGTERM."""
    import rclpy

    from us_sim.run.lockstep import node_in_process

    ended = threading.Event()
    rclpy.init(args=[])
    signal.signal(signal.SIGTERM, lambda *_: ended.set())
    context = rclpy.get_default_context()
    made = [node_in_process(name, parameters, context) for name, parameters in json.loads(nodes)]
    threads = [threading.Thread(target=_spin, args=(node, context), daemon=True) for node in made]
    for thread in threads:
        thread.start()
    ended.wait()
    rclpy.try_shutdown()
    for thread in threads:
        thread.join(timeout=2.0)
    for node in reversed(made):
        node.destroy_node()


def _cut_large_volume(side: str) -> None:
    from us_sim.evaluation.slice.cases import MAIN
    from us_sim.slicing.cutting.slicer import create_slicer
    from us_sim.volume.volume import Volume

    count = int(side)
    voxels = np.random.default_rng(1).integers(0, 256, (count,) * 3, dtype=np.uint8)
    placed = np.diag([0.21 / count, 0.11 / count, 0.11 / count, 1.0])
    placed[:3, 3] = -0.105, -0.055, -0.005
    mesh = MAIN.mesh()
    slicer = create_slicer(
        "scan_conversion", Volume(voxels, placed), mesh.nodes, mesh.tetrahedra, threads=2
    )
    for frame in MAIN.frames(8):
        slicer.image(frame.nodes, frame.plane)
    print(_own_peak() or "")


def _own_peak() -> int | None:
    """Peak memory of this process, bytes; on Linux ``ru_maxrss`` counts a parent's pages too."""
    try:
        for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    try:
        import resource
    except ImportError:
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # bytes, on macOS


def _watch_images() -> None:

    import rclpy  # isort: skip
    from rclpy.node import Node
    from sensor_msgs.msg import Image

    from us_sim.nodes.qos import STREAM

    rclpy.init()
    node = Node("slice_publishing_watcher")
    node.create_subscription(Image, "us_sim_slice_publishing/image", lambda _: None, STREAM)
    rclpy.spin(node)


def _publish_images(side: str) -> None:

    import rclpy  # isort: skip
    from rclpy.node import Node
    from sensor_msgs.msg import Image

    from us_sim.nodes.messages import image_message
    from us_sim.nodes.qos import STREAM

    rclpy.init()
    node = Node("slice_publishing")
    publisher = node.create_publisher(Image, "us_sim_slice_publishing/image", STREAM)
    pixels = np.random.default_rng(1).integers(0, 256, (int(side),) * 2, dtype=np.uint8)
    stamp = node.get_clock().now().to_msg()
    begin = time.perf_counter()
    while publisher.get_subscription_count() == 0:
        if time.perf_counter() - begin > 60.0:
            return
        time.sleep(0.05)
    found = []
    due = time.perf_counter()
    for _ in range(180):
        due += 1.0 / 60.0
        time.sleep(max(0.0, due - time.perf_counter()))
        before = time.perf_counter()
        publisher.publish(image_message(pixels, stamp, "probe"))
        found.append((time.perf_counter() - before) * 1e3)
    print(statistics.median(found))


if __name__ == "__main__":
    {
        "nodes": _run_nodes,
        "memory": _cut_large_volume,
        "watch": _watch_images,
        "publish": _publish_images,
    }[sys.argv[1]](*sys.argv[2:])  # type: ignore[operator]
