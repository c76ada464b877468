"""Ends random nodes of a running graph, again and again, and measures how soon it is back.

    python tests/graph/many_restarts.py --count 1000

A node is killed, told to end or stopped; then it is waited until images come at nine tenths of the
rate of before again and the node has reported. It is an error when another node was started again.
"""

import argparse
import collections
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

SCENE = """
name: restarts
based_on: upper_arm
probe: {image: [64, 64]}
"""
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGSTOP)
WINDOW_S = 0.5
FULL = 0.9
PATH_RATE = 60.0  # poses a second; images that waited come faster for a moment
LIMIT_S = 60.0
PATIENCE_S = 10.0


@dataclass(frozen=True)
class Restart:
    """One node that was ended."""

    node: str
    number: signal.Signals
    seconds: float  # until all was as before
    others: tuple[str, ...]  # nodes that have another process now, too


class Listener:
    """Hears the images, and which processes of nodes report."""

    def __init__(self):
        import rclpy
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node
        from sensor_msgs.msg import Image

        from us_sim.nodes import announce_often
        from us_sim.nodes.session_monitor import SessionMonitor
        from us_sim.nodes.settings import NODES

        announce_often()  # as the page does
        self._context = Context()
        rclpy.init(args=[], context=self._context)
        node = Node("restarts_listener", context=self._context)
        self.monitor = SessionMonitor(list(NODES), context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        for each in (node, self.monitor):
            self._executor.add_node(each)
        self.times = collections.deque(maxlen=10_000)
        self.usual_rate = 0.0  # images a second
        node.create_subscription(
            Image, "ultrasound/image", lambda _: self.times.append(time.monotonic()), 100
        )

    def spin(self, seconds):
        """Take what comes for so long."""
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            self._executor.spin_once(timeout_sec=0.02)

    @property
    def pids(self):
        """The process of each node that reported last."""
        return {node: int(report["pid"]) for node, report in self.monitor.reports.items()}

    def rate(self, since):
        """Images a second since a time on the monotonic clock."""
        return sum(t >= since for t in self.times) / (time.monotonic() - since)

    def wait_for_full_rate(self):
        """Until images come at their usual rate for two seconds, or that has become slower.

        Meanwhile the supervisor hears of who has just come: nodes report once a second.
        """
        self.spin(1.5)
        until = time.monotonic() + PATIENCE_S
        while time.monotonic() < until:
            self.spin(0.5)
            rate = self.rate(time.monotonic() - 2.0)
            if rate >= FULL * self.usual_rate:
                break
        now = min(self.rate(time.monotonic() - 2.0), PATH_RATE)
        self.usual_rate = max(now, 0.5 * self.usual_rate)

    def full_since(self, after, rate):
        """When a window began, after a time, in which images came at that rate; None if none."""
        times = [t for t in self.times if t >= after]
        wanted = int(FULL * rate * WINDOW_S)
        for first, last in zip(times, times[wanted - 1 :], strict=False):
            if last - first <= WINDOW_S:
                return first
        return None

    def close(self):
        """Leave the domain."""
        self._executor.shutdown()
        self._context.try_shutdown()


KEEPS, FORKS = "us_sim keeper", "us_sim nodes"  # the titles of what forks what forks them


def children_of(parent):
    """The processes that a process has started, by title."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
            title = (folder / "cmdline").read_bytes().partition(b"\0")[0].decode()
        except OSError:
            continue
        if int(fields[1]) == parent and fields[0] != "Z":
            found[title] = int(folder.name)
    return found


def nodes_of(run):
    """The process of each node that a simulation has started, which bears the node's name."""
    from us_sim.nodes.settings import NODES

    own = children_of(run)
    for title in KEEPS, FORKS:
        own |= children_of(own[title]) if title in own else {}
    return {title: pid for title, pid in own.items() if title in NODES}


def forks_of(run):
    """The process that forks a simulation's nodes."""
    return children_of(children_of(run)[KEEPS])[FORKS]


def restart(listener, node, number, own):
    """End a process and wait until all is as before: nodes report, images come at their rate.

    What forks nodes ends with all of them.
    """
    before = listener.pids
    ended = own.keys() - {FORKS} if node == FORKS else {node}
    rate = listener.usual_rate
    began = time.monotonic()
    os.kill(own[node], number)
    back = full = None
    while back is None or full is None:
        listener.spin(0.1)
        if back is None and all(listener.pids[each] != before[each] for each in ended):
            back = time.monotonic() - began
        # What was on its way when the node ended does not make a window full.
        full = listener.full_since(began + 0.1, rate)
        if time.monotonic() - began > LIMIT_S:
            silent = sorted(each for each in ended if listener.pids[each] == before[each])
            raise SystemExit(
                f"{node} was not back {LIMIT_S:g} s after {number.name}: {rate:.1f} images/s "
                f"before, no report of {', '.join(silent) or 'none'}"
            )
    makes_images = node not in ("session_recorder", "skin_deformer")
    seconds = full - began if makes_images else back
    now = listener.pids
    others = tuple(n for n in before if n not in ended and now[n] != before[n])
    return Restart(node, number, seconds, others)


def start(folder, scene, path):
    """`us-sim run` with a path that begins again at its end, recorded; it may restart for ever."""
    command = [sys.executable, "-m", "us_sim", "run", str(scene), "--path", str(path)]
    command += ["--record", str(folder / "session.mcap"), "--param", "path_player.loop=true"]
    command += ["--restarts", "1000000", "--silence", "2"]
    with (folder / "said.txt").open("w") as said:
        return subprocess.Popen(command, stderr=said, stdout=said)


def main():
    """As the module says."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=1e9, help="end after so long")
    asked = parser.parse_args()
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    chance = random.Random(asked.seed)
    folder = Path(tempfile.mkdtemp(prefix="restarts-"))
    scene = folder / "scene.yaml"
    scene.write_text(SCENE)
    listener = Listener()
    segments = set(Path("/dev/shm").glob("*fastrtps_*"))
    run = start(folder, scene, "press_and_slide.mcap")
    done = []
    try:
        while len(listener.times) < 120:
            listener.spin(0.5)
            assert run.poll() is None, (folder / "said.txt").read_text()
        ends = time.monotonic() + 60.0 * asked.minutes
        while len(done) < asked.count and time.monotonic() < ends:
            listener.spin(1.0 + chance.random())
            listener.wait_for_full_rate()
            own = nodes_of(run.pid) | {FORKS: forks_of(run.pid)}
            node = chance.choice(sorted(own))
            number = signal.SIGKILL if node == FORKS else chance.choice(SIGNALS)
            done.append(restart(listener, node, number, own))
            print(len(done), node, done[-1].number.name, f"{done[-1].seconds:.2f} s", flush=True)
            assert not done[-1].others, done[-1]
            for file in sorted(folder.glob("*.mcap"), key=lambda f: f.stat().st_mtime)[:-2]:
                file.unlink()
    finally:
        nodes = nodes_of(run.pid)
        run.send_signal(signal.SIGINT)
        run.wait(30)
        listener.close()
    assert not any(Path(f"/proc/{pid}").exists() for pid in nodes.values())
    left = set(Path("/dev/shm").glob("*fastrtps_*")) - segments
    print("left in shared memory:", *sorted(file.name for file in left))  # of this and other runs
    print(f"{len(done)} restarts, status {run.returncode}; what was said is in {folder}/said.txt")
    for name in (*sorted({each.node for each in done}), ""):
        seconds = [each.seconds for each in done if name in ("", each.node)]
        p50, p99, most = np.percentile(seconds, [50, 99, 100])
        late = sum(each > 3.0 for each in seconds)
        print(
            f"{name or 'all':<20} {len(seconds):>5}: median {p50:.2f} s, 99 of 100 within "
            f"{p99:.2f} s, all within {most:.2f} s, {late} later than 3 s"
        )


if __name__ == "__main__":
    main()
