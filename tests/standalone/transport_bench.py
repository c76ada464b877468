"""What the tests of the transport share: topics, a bell to wait by, and other processes."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable

from us_sim.standalone.cdr import serialize
from us_sim.standalone.ddsc import EndpointQos
from us_sim.standalone.messages import message_class
from us_sim.standalone.transport import DiscoveryRange

LOCALHOST = DiscoveryRange("LOCALHOST")
IMAGE = "sensor_msgs::msg::dds_::Image_"
STRING = "std_msgs::msg::dds_::String_"
RELIABLE = EndpointQos(depth=10)
LATCHED = EndpointQos(depth=1, durability=EndpointQos.TRANSIENT_LOCAL)
BEST_EFFORT = EndpointQos(depth=1, reliability=EndpointQos.BEST_EFFORT)
HELLO = serialize(message_class("std_msgs/msg/String")(data="hello"))


class Doorbell:
    """Rung by the transport's thread; a test waits on it until something holds."""

    def __init__(self) -> None:
        self._rung = threading.Event()

    def ring(self, *_: object) -> None:
        self._rung.set()

    def wait_until(self, condition: Callable[[], object], timeout: float = 10.0) -> None:
        deadline = time.monotonic() + timeout
        while not condition():
            remaining = deadline - time.monotonic()
            assert remaining > 0, "what was waited for did not happen"
            self._rung.wait(min(remaining, 0.01))  # matches and the graph ring no bell
            self._rung.clear()


class Child:
    """Another process that runs ``script`` with the domain as its argument."""

    def __init__(self, script: str, domain: int) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", script, str(domain)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"},
        )

    def __enter__(self) -> "Child":
        return self

    def __exit__(self, *_: object) -> None:
        self.process.send_signal(signal.SIGCONT)
        self.process.kill()
        self.process.communicate()


LISTENER = """
import sys
from us_sim.standalone.ddsc import EndpointQos
from us_sim.standalone.graph import Graph, GraphNode
from us_sim.standalone.transport import Participant
participant = Participant(int(sys.argv[1]))
reader = participant.create_reader(
    "rt/ping", "sensor_msgs::msg::dds_::Image_", EndpointQos(), "typehash=RIHS01_12;"
)
Graph(participant).announce([GraphNode("/us", "listener", (reader.gid,))])
print("ready", flush=True)
sys.stdin.read()
"""


def take_one(reader, bell):
    taken = []
    bell.wait_until(lambda: taken.append(reader.take()) or taken[-1] is not None)
    return taken[-1]
