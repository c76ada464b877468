"""A running graph given messages that no driver would send: `python -m tests.fuzz.attack`.

The nodes of a scene run as processes. On every topic and parameter service that one of them takes,
messages go out that their type allows and the simulation does not, and bytes that are no message.
After every round good poses must still become images, no node may have ended or be silent, what
goes out must be finite, and memory must stay bounded. What was sent in a round after which that is
not so is written down.
"""

from __future__ import annotations

import argparse
import os
import random
import struct
import sys
import tempfile
import time
from collections import deque
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from tests.fuzz.good_input import good_input
from us_sim.evaluation.processes import usage_of
from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.settings import NODES
from us_sim.progress import Progress
from us_sim.run.plan import NodeProcess, simulation_nodes
from us_sim.run.processes import ProcessGroup, prepare_ros
from us_sim.scene.reading import load_scene
from us_sim.scene.scene import Scene
from us_sim.settings.setting import kinds_of

import rclpy  # isort: skip - provided by us_sim.nodes where ROS 2 is not installed
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces import srv
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Image, PointCloud2

ROUND = 2000
"""Messages between two looks at the graph."""
RATE = 3000.0
"""Messages a second at most: the nodes must come to read them."""
PATIENCE = 20.0
"""Seconds for a good pose to become an image."""
MEMORY = 2e9
"""Bytes of a process that are too many."""
EDGES = {
    "f": [0.0, -0.0, 1e-45, 3.4e38, -3.4e38, np.nan, np.inf, -np.inf],
    "d": [0.0, -0.0, 5e-324, 1e-200, 1e7, 1e200, 1.7e308, -1.7e308, np.nan, np.inf, -np.inf],
}
TEXTS = ["", "patient", "probe", "/", "x", "y", "z", "mono8", "16UC1", "a" * 300, "ä", "a\nb"]
HEADER = b"\0\1\0\0"
BYTES = [HEADER + b"\0", HEADER + b"\xff" * 64, bytes(64), HEADER + b"\xff" * 5000]


SERVICES = {
    "describe_parameters": srv.DescribeParameters,
    "get_parameters": srv.GetParameters,
    "list_parameters": srv.ListParameters,
    "set_parameters": srv.SetParameters,
    "set_parameters_atomically": srv.SetParametersAtomically,
}


class Topic:
    """A topic that nodes take, and what is sent to it."""

    def __init__(self, node: Node, topic: str, type_name: str, *, latched: bool) -> None:
        package, _, name = type_name.split("/")
        self.topic = topic
        self._type = getattr(import_module(f"{package}.msg"), name)
        qos = QoSProfile(depth=5)
        if latched:
            qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
        self._publisher = node.create_publisher(self._type, topic, qos)
        self._seeds = [serialize_message(self._type())]
        # What is good and goes by: most of what is sent differs from it in a little.
        self._learning = node.create_subscription(self._type, topic, self._learn, qos, raw=True)

    def _learn(self, data: bytes) -> None:
        if len(self._seeds) < 4 and len(data) > len(self._seeds[0]):
            self._seeds.append(bytes(data))

    def begin(self, node: Node) -> None:
        """Learn no more: what comes next is not good."""
        node.destroy_subscription(self._learning)

    def send(self, rng: random.Random) -> bytes:
        """Send something, and return it."""
        data = self._payload(rng)
        self._publisher.publish(data)
        return data

    def _payload(self, rng: random.Random) -> bytes:
        way, seed = rng.random(), rng.choice(self._seeds)
        if way < 0.5:
            message = deserialize_message(seed, self._type)
            for _ in range(rng.randint(1, 3)):
                spoil(message, rng)
            return bytes(serialize_message(message))
        if way < 0.55:
            return rng.choice(BYTES)
        if way < 0.65:
            return seed[: rng.randrange(5, len(seed) + 1)]
        data = bytearray(seed)
        for _ in range(rng.randint(1, 6)):
            place = rng.randrange(4, max(5, min(len(data), 400)))
            edges = [0, 1, 2**31 - 2, 2**31, 2**32 - 1, rng.getrandbits(32)]
            data[place : place + 4] = struct.pack("<I", rng.choice(edges))
        return bytes(data)


class Service:
    """A parameter service of a node, and what is asked of it."""

    def __init__(self, node: Node, name: str, of: str, names: list[str]) -> None:
        self._type = SERVICES[name]
        self.topic = f"{of}/{name}"
        self._client = node.create_client(self._type, self.topic)
        self._names = names

    def send(self, rng: random.Random) -> bytes:
        """Ask something, and return it; nobody waits for the answer."""
        request = self._type.Request()
        own = import_module("rcl_interfaces.msg")
        if hasattr(request, "names"):
            request.names = rng.choices([*self._names, *TEXTS], k=rng.randrange(4))
        elif hasattr(request, "prefixes"):
            request.prefixes = rng.choices([*self._names, *TEXTS], k=rng.randrange(4))
        else:
            for _ in range(rng.randrange(1, 4)):
                value = own.ParameterValue(
                    type=rng.randrange(256) if rng.random() < 0.1 else rng.randrange(10)
                )
                for _ in range(4):
                    spoil(value, rng)
                parameter = own.Parameter(name=rng.choice([*self._names, *TEXTS]), value=value)
                request.parameters.append(parameter)
        self._client.remove_pending_request(self._client.call_async(request))
        return repr(request).encode()


def spoil(message: Any, rng: random.Random) -> None:
    """Give one field, somewhere in a message, a value at the edge of what its type allows."""
    fields = message.get_fields_and_field_types()
    name = rng.choice(list(fields))
    value = getattr(message, name)
    if isinstance(value, list) and value and hasattr(value[0], "get_fields_and_field_types"):
        if rng.random() < 0.2:
            setattr(message, name, rng.choice([[], value * 2]))
        else:
            spoil(rng.choice(value), rng)
    elif hasattr(value, "get_fields_and_field_types"):
        spoil(value, rng)
    elif isinstance(value, bool):
        setattr(message, name, not value)
    elif isinstance(value, int):
        setattr(message, name, edge_of(fields[name], rng))
    elif isinstance(value, float):
        setattr(message, name, float(rng.choice(EDGES["f" if fields[name] == "float" else "d"])))
    elif isinstance(value, str):
        setattr(message, name, rng.choice(TEXTS))
    elif hasattr(value, "typecode"):
        spoil_numbers(message, name, value, rng)
    elif isinstance(value, np.ndarray) and len(value) and value.dtype.kind == "f":
        value[rng.randrange(len(value))] = rng.choice(EDGES["d"])


def spoil_numbers(message: Any, name: str, value: Any, rng: random.Random) -> None:
    """Likewise for a sequence of numbers: fewer, more, or another."""
    values = value[:]
    way = rng.random()
    if way < 0.3:
        values = values[: rng.randrange(len(values) + 1)]
    elif way < 0.4:
        values = values + values[:7]
    elif len(values):
        edges = EDGES.get(values.typecode) or [0, 1, 2 ** (8 * values.itemsize - 1) - 1]
        values[rng.randrange(len(values))] = rng.choice(edges)
    setattr(message, name, values)


def edge_of(kind: str, rng: random.Random) -> int:
    """An integer of a kind such as ``uint32``, near where it ends or sums overflow."""
    bits = int("".join(filter(str.isdigit, kind)) or 8)
    low, high = (
        (0, 2**bits) if kind.startswith(("u", "char")) else (-(2 ** (bits - 1)), 2 ** (bits - 1))
    )
    edges = [low, high - 1, 0, 1, 999_999_999, 10**9, 2**31 - 4, 2**31, 2**31 + 1, -1]
    return rng.choice([edge for edge in edges if low <= edge < high])


class Attack:
    """A graph that runs, and what is sent to it."""

    def __init__(self, processes: list[NodeProcess], scene: Scene, folder: Path, seed: int) -> None:
        self._rng = random.Random(seed)
        self._group = ProcessGroup(folder / "nodes.log")
        self._group.start(processes)
        self._node = GuardedNode("attacker")  # what it sends comes back to it, too
        self._input = good_input(self._node, scene)
        self._sent: deque[tuple[str, bytes]] = deque(maxlen=ROUND)
        self._reported: dict[str, float] = {}
        self._images: set[int] = set()
        self._good: set[int] = set()  # stamps of the good poses since the last round, ns
        self._bad_nodes = 0
        self._node.create_subscription(DiagnosticArray, "diagnostics", self._report, 100)
        self._node.create_subscription(Image, "ultrasound/image", self._image, 10)
        self._node.create_subscription(PointCloud2, "tissue/nodes", self._tissue, 10)
        with Progress("starting", len(self._group.pids), "nodes") as bar:
            while waiting := set(self._group.pids) - set(self._reported):
                self._spin(0.2)
                self._require_all()
                bar.update(len(self._group.pids) - len(waiting), ", ".join(sorted(waiting)))
        self._spin(2.0)
        topics = self._topics()
        for number in range(60):
            if self._input is not None:
                self._input.send(number)
            self._spin(0.05)
        for topic in topics:
            topic.begin(self._node)
        self.targets: list[Topic | Service] = [*topics, *self._services()]

    def _topics(self) -> list[Topic]:
        found = []
        for topic, types in self._node.get_topic_names_and_types():
            taken = [
                info
                for info in self._node.get_subscriptions_info_by_topic(topic)
                if info.node_name in self._group.pids
            ]
            if taken:
                latched = any(
                    info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
                    for info in taken
                )
                found.append(Topic(self._node, topic, types[0], latched=latched))
        return found

    def _services(self) -> list[Service]:
        names = {
            node: [name for settings in NODES.get(node, ()) for name in kinds_of(settings)]
            for node in self._group.pids
        }
        return [Service(self._node, name, node, names[node]) for node in names for name in SERVICES]

    def round(self) -> str:
        """Send a round, and look at the graph; what is wrong with it, if anything is."""
        self._sent.clear()
        for number in range(ROUND):
            target = self._rng.choice(self.targets)
            self._sent.append((target.topic, target.send(self._rng)))
            if number % 20 == 0:
                self._spin(20 / RATE)
        return self._fault()

    def _fault(self) -> str:
        try:
            self._require_all()
            self._require_images()
        except RuntimeError as error:
            return str(error)
        for node, pid in self._group.pids.items():
            usage = usage_of(pid)
            if usage is not None and usage.memory > MEMORY:
                return f"{node} has taken {1e-9 * usage.memory:.1f} GB"
        return ""

    def _require_all(self) -> None:
        for node in self._group.pids:
            if not self._group.is_running(node):
                raise RuntimeError(f"{node} has ended")

    def _require_images(self) -> None:
        """Good poses become images again, all nodes report, and the tissue is finite."""
        began, sent = time.monotonic(), []
        self._good.clear()  # what is spoiled has stamps from before
        self._bad_nodes = 0
        while time.monotonic() - began < PATIENCE:
            if self._input is not None:
                sent.append(self._input.send(len(sent)))
                self._good.add(sent[-1])
            self._spin(0.05)
            self._require_all()
            silent = [n for n in self._group.pids if time.monotonic() - self._reported[n] > 5.0]
            there = self._input is None or len(self._images & set(sent[5:])) > 5
            if there and not silent:
                break
        else:
            raise RuntimeError(f"{', '.join(silent)} silent" if silent else "poses give no images")
        if self._bad_nodes:
            raise RuntimeError("tissue/nodes is not finite")

    def write_down(self, file: Path) -> None:
        """Write the messages of the last round."""
        lines = [f"{topic} {data.hex()}" for topic, data in self._sent]
        file.write_text("\n".join(lines), encoding="utf-8")

    def close(self) -> None:
        """End the graph."""
        self._node.destroy_node()
        self._group.stop()

    def _spin(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while (rest := end - time.monotonic()) > 0:
            rclpy.spin_once(self._node, timeout_sec=rest)

    def _report(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self._reported[status.name.rsplit("/", 1)[-1]] = time.monotonic()

    def _image(self, message: Image) -> None:
        self._images.add(1_000_000_000 * message.header.stamp.sec + message.header.stamp.nanosec)

    def _tissue(self, message: PointCloud2) -> None:
        stamp = 1_000_000_000 * message.header.stamp.sec + message.header.stamp.nanosec
        values = np.frombuffer(message.data[: len(message.data) // 4 * 4], "<f4")
        self._bad_nodes += stamp in self._good and not np.isfinite(values).all()


def main(arguments: list[str]) -> int:
    """Attack the nodes of one scene after another; 1 where a round left something wrong."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz.attack", description=__doc__)
    parser.add_argument("scenes", nargs="*", default=["upper_arm"])
    parser.add_argument("--messages", type=int, default=100_000, help="to each scene's nodes")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("attack_failures"))
    args = parser.parse_args(arguments)
    prepare_ros(network=False)
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    rclpy.init(args=[])
    failed = 0
    for name in args.scenes:
        failed += _attack(name, args)
    rclpy.try_shutdown()
    return 1 if failed else 0


def _attack(name: str, args: argparse.Namespace) -> int:
    scene = load_scene(name)
    processes = simulation_nodes(scene)
    rounds, failed = -(-args.messages // ROUND), 0
    attack = None
    with (
        tempfile.TemporaryDirectory(prefix="us_sim_attack_") as folder,
        Progress(f"attacking {name}", rounds * ROUND, "messages") as bar,
    ):
        try:
            for number in range(rounds):
                if attack is None:
                    place = Path(tempfile.mkdtemp(dir=folder))
                    attack = Attack(processes, scene, place, args.seed + number)
                if fault := attack.round():
                    failed += 1
                    args.out.mkdir(parents=True, exist_ok=True)
                    attack.write_down(args.out / f"{name}-{args.seed}-{number}.txt")
                    log = (place / "nodes.log").read_text(encoding="utf-8").splitlines()[-12:]
                    print("\n".join([f"{name}, round {number}: {fault}", *log]), flush=True)
                    attack.close()
                    attack = None
                bar.update((number + 1) * ROUND, f"{failed} rounds failed")
        finally:
            if attack is not None:
                attack.close()
    print(f"{name}: {rounds * ROUND} messages, {failed} of {rounds} rounds failed")
    return failed


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
