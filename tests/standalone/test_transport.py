"""Serialized samples, the graph and services over DDS, between participants and processes."""

import array
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from us_sim.standalone.cdr import deserialize, serialize
from us_sim.standalone.libddsc import DdsError
from us_sim.standalone.messages import message_class
from us_sim.standalone.middleware import EndpointQos, GraphNode, MiddlewareError, qos_of_profile

try:
    from us_sim.standalone.graph import Graph
    from us_sim.standalone.services import ServiceServer
    from us_sim.standalone.transport import DiscoveryRange, Participant
except DdsError as error:  # zenoh takes its place there
    pytest.skip(str(error), allow_module_level=True)

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
from us_sim.standalone.middleware import EndpointQos
from us_sim.standalone.graph import Graph
from us_sim.standalone.middleware import GraphNode
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


@pytest.fixture(scope="module")
def domain() -> int:
    return random.Random().randint(1, 100)


@pytest.fixture
def participant(domain: int) -> Iterator[Any]:
    with Participant(domain, reach=LOCALHOST) as participant:
        yield participant


@pytest.fixture
def neighbour(domain: int) -> Iterator[Any]:
    with Participant(domain, reach=LOCALHOST) as participant:
        yield participant


@pytest.fixture
def bell() -> Any:
    return Doorbell()


ECHO = """
import sys, threading
from us_sim.standalone.middleware import EndpointQos
from us_sim.standalone.cdr import deserialize, serialize
from us_sim.standalone.messages import message_class
from us_sim.standalone.transport import Participant
Image, dds_type = message_class("sensor_msgs/msg/Image"), "sensor_msgs::msg::dds_::Image_"
participant = Participant(int(sys.argv[1]))
writer = participant.create_writer("rt/pong", dds_type, EndpointQos())
reader = participant.create_reader("rt/ping", dds_type, EndpointQos())
came = threading.Event()
reader.set_on_data(came.set)
while came.wait():
    came.clear()
    while (sample := reader.take()) is not None:
        writer.write(serialize(deserialize(sample[0], Image)))
"""


def connected_pair(participant, bell, qos=RELIABLE, dds_type=IMAGE):
    writer = participant.create_writer("rt/ping", dds_type, qos)
    reader = participant.create_reader("rt/pong", dds_type, qos)
    reader.set_on_data(bell.ring)
    bell.wait_until(lambda: writer.matched_count() and reader.matched_count())
    return writer, reader


def test_an_image_to_another_process_and_back_takes_two_milliseconds_at_most(
    participant, domain, bell
):
    Image = message_class("sensor_msgs/msg/Image")
    image = Image(height=512, width=512, encoding="mono8", step=512)
    image.data = array.array("B", os.urandom(512 * 512))
    seconds = []
    with Child(ECHO, domain):
        writer, reader = connected_pair(participant, bell)
        for _ in range(200):
            start = time.process_time()
            assert writer.write(serialize(image))
            back = deserialize(take_one(reader, bell)[0], Image)
            seconds.append(time.process_time() - start)
            assert back.data == image.data
    assert sorted(seconds)[100] < 2e-3


def test_messages_of_all_sizes_arrive_as_they_were_sent(participant, domain, bell):
    Image = message_class("sensor_msgs/msg/Image")
    with Child(ECHO, domain):
        writer, reader = connected_pair(participant, bell)
        for size in (0, 1, 2, 3, 4, 1343, 1345, 65_499, 65_537, 1_048_576, 3_000_001):
            data = serialize(Image(encoding="x" * (size % 5), data=os.urandom(size)))
            writer.write(data)
            received, info = take_one(reader, bell)
            assert received == data
            assert 0 < info.source_timestamp <= info.received_timestamp


def test_a_latched_sample_reaches_who_comes_later(participant, neighbour, bell):
    writer = participant.create_writer("rt/latched", STRING, LATCHED)
    writer.write(serialize(message_class("std_msgs/msg/String")(data="old")))
    writer.write(HELLO)
    reader = neighbour.create_reader("rt/latched", STRING, LATCHED)
    volatile = neighbour.create_reader("rt/latched", STRING, RELIABLE)
    reader.set_on_data(bell.ring)
    assert take_one(reader, bell)[0] == HELLO
    assert reader.take() is None
    bell.wait_until(volatile.matched_count)
    assert volatile.take() is None


def test_who_comes_later_gets_as_many_latched_samples_as_are_kept(participant, neighbour, bell):
    three = EndpointQos(depth=3, durability=EndpointQos.TRANSIENT_LOCAL)
    writer = participant.create_writer("rt/latched", STRING, three)
    sent = [serialize(message_class("std_msgs/msg/String")(data=text)) for text in "abcd"]
    for data in sent:
        writer.write(data)
    reader = neighbour.create_reader("rt/latched", STRING, three)
    reader.set_on_data(bell.ring)
    assert [take_one(reader, bell)[0] for _ in range(3)] == sent[1:]
    assert reader.take() is None


def test_data_that_came_before_the_callback_is_announced_to_it(participant, bell):
    reader = participant.create_reader("rt/early", STRING, RELIABLE)
    participant.create_writer("rt/early", STRING, RELIABLE).write(HELLO)
    taken = []

    def take():
        taken.append(reader.take())
        bell.ring()

    reader.set_on_data(take)
    bell.wait_until(lambda: taken)
    assert taken[0][0] == HELLO


def test_a_participant_can_leave_out_its_own_samples(participant, neighbour, bell):
    writer = participant.create_writer("rt/own", STRING, RELIABLE)
    own = participant.create_reader("rt/own", STRING, RELIABLE, ignore_own=True)
    other = neighbour.create_reader("rt/own", STRING, RELIABLE)
    other.set_on_data(bell.ring)
    writer.write(HELLO)
    assert take_one(other, bell)[0] == HELLO
    assert own.take() is None


def test_keep_last_keeps_the_newest(participant):
    reader = participant.create_reader("rt/newest", STRING, EndpointQos(depth=2))
    writer = participant.create_writer("rt/newest", STRING, RELIABLE)
    for letter in "abc":
        writer.write(b"\0\1\0\0" + letter.encode() * 4)
    assert [reader.take()[0][4:], reader.take()[0][4:]] == [b"bbbb", b"cccc"]
    assert reader.take() is None


def test_incompatible_quality_of_service_is_reported_to_both(participant, neighbour, bell):
    told = []

    def teller(side):
        return lambda policy: told.append((side, policy))

    topic = ("rt/quality", STRING)
    writer = participant.create_writer(*topic, BEST_EFFORT, on_incompatible=teller("writer"))
    reader = neighbour.create_reader(*topic, RELIABLE, on_incompatible=teller("reader"))
    bell.wait_until(lambda: len(told) == 2)
    assert set(told) == {("writer", "RELIABILITY"), ("reader", "RELIABILITY")}
    assert writer.matched_count() == reader.matched_count() == 0


def test_matches_are_counted(participant, neighbour, bell):
    writer = participant.create_writer("rt/matched", STRING, RELIABLE)
    reader = neighbour.create_reader("rt/matched", STRING, BEST_EFFORT, "typehash=abc;")
    bell.wait_until(lambda: writer.matched_count() == 1)
    assert writer.matched_user_data() == [{"typehash": "abc"}]
    reader.close()
    bell.wait_until(lambda: writer.matched_count() == 0)


BUSY_UNTIL_THE_END = """
import sys, threading
from us_sim.standalone.middleware import EndpointQos
from us_sim.standalone.transport import Participant
first, second = Participant(int(sys.argv[1])), Participant(int(sys.argv[1]))
topic = ("rt/busy", "std_msgs::msg::dds_::String_", EndpointQos())
writer, reader = first.create_writer(*topic), second.create_reader(*topic)
received, enough = [], threading.Event()
def take():
    while reader.take() is not None:
        received.append(1)
        if len(received) == 20:
            enough.set()
        writer.write(bytes.fromhex("00010000 00000000"))
reader.set_on_data(take)
writer.write(bytes.fromhex("00010000 00000000"))
enough.wait()
print(20, flush=True)
"""


def test_a_process_ends_silently_with_traffic_going_on(domain):
    child = Child(BUSY_UNTIL_THE_END, domain)
    output, errors = child.process.communicate(timeout=20)
    assert (output, errors) == ("20\n", "")
    assert child.process.returncode == 0


def test_a_suspended_reader_does_not_block_a_keep_last_writer(participant, domain, bell):
    with Child(LISTENER, domain) as child:
        writer = participant.create_writer("rt/ping", IMAGE, RELIABLE)
        bell.wait_until(writer.matched_count)
        child.process.send_signal(signal.SIGSTOP)
        start = time.perf_counter()
        for _ in range(100):
            assert writer.write(b"\0\1\0\0" + bytes(262_144))
        writer.close()
        assert time.perf_counter() - start < 10.0  # a write that blocks does so for 0.1 s


def test_what_was_closed_is_closed(domain):
    participant = Participant(domain, reach=LOCALHOST)
    writer = participant.create_writer("rt/closed", STRING, RELIABLE)
    reader = participant.create_reader("rt/closed", STRING, RELIABLE)
    graph = Graph(participant)
    writer.write(HELLO)
    writer.close()
    writer.close()
    with pytest.raises(DdsError, match="the writer is closed"):
        writer.write(HELLO)
    graph.close()
    participant.close()
    participant.close()
    assert reader.take() is None
    assert reader.matched_count() == 0
    assert graph.endpoints() == graph.nodes() == []
    graph.announce([])
    with pytest.raises(DdsError, match="the participant is closed"):
        participant.create_reader("rt/closed", STRING, RELIABLE)


def test_closing_from_a_callback_does_not_deadlock(domain, bell):
    participant = Participant(domain, reach=LOCALHOST)
    reader = participant.create_reader("rt/suicide", STRING, RELIABLE)
    writer = participant.create_writer("rt/suicide", STRING, RELIABLE)
    closed = []

    def close():
        if reader.take() is not None:
            participant.close()
            closed.append(True)
            bell.ring()

    reader.set_on_data(close)
    writer.write(HELLO)
    bell.wait_until(lambda: closed)


def test_bytes_that_are_no_sample_are_refused(participant):
    writer = participant.create_writer("rt/nothing", STRING, RELIABLE)
    for data in (b"", b"abc", b"\0\1\0\0", b"\xff\xff\0\0abcd"):
        with pytest.raises(DdsError, match="not a sample"):
            writer.write(data)


def by_name(graph):
    """The nodes of a graph; other tests' may be among them, which run at the same time."""
    return {node.name: node for node in graph.nodes()}


def test_the_graph_shows_nodes_and_endpoints_of_other_processes(participant, domain, bell):
    graph = Graph(participant)
    writer = participant.create_writer("rt/ping", IMAGE, LATCHED)
    graph.announce([GraphNode("/", "here", writer_gids=(writer.gid,))])
    with Child(LISTENER, domain):
        bell.wait_until(
            lambda: (
                {"here", "listener"} <= set(by_name(graph)) and len(graph.endpoints("rt/ping")) == 2
            )
        )
        here, there = by_name(graph)["here"], by_name(graph)["listener"]
        assert (here.namespace, here.name, here.participant) == ("/", "here", participant.gid)
        assert (there.namespace, there.name) == ("/us", "listener")
        endpoints = {endpoint.is_writer: endpoint for endpoint in graph.endpoints("rt/ping")}
        assert endpoints[True].gid == writer.gid
        assert endpoints[True].qos == LATCHED
        assert endpoints[False].gid == there.reader_gids[0]
        assert endpoints[False].participant == there.participant
        assert endpoints[False].type_name == IMAGE
        assert endpoints[False].qos == RELIABLE
        assert endpoints[False].user_data == {"typehash": "RIHS01_12"}


ANNOUNCER_THAT_ENDS = LISTENER.replace("sys.stdin.read()", "")


def test_who_ends_is_gone_from_the_graph_at_once(participant, domain, bell):
    graph = Graph(participant)
    child = Child(ANNOUNCER_THAT_ENDS, domain)
    assert child.process.wait(10) == 0
    bell.wait_until(
        lambda: "listener" not in by_name(graph) and not graph.endpoints("rt/ping"), 2.0
    )
    assert child.process.communicate() == ("ready\n", "")


def test_service_endpoints_are_named_as_rmw_cyclonedds_names_them(participant):
    server = ServiceServer(participant, "/n/get", "rcl_interfaces/srv/GetParameters", RELIABLE)
    graph = Graph(participant)
    request = graph.endpoints("rq/n/getRequest")[0]
    reply = graph.endpoints("rr/n/getReply")[0]
    assert ([request.gid], [reply.gid]) == server.gids
    assert (request.is_writer, reply.is_writer) == (False, True)
    assert request.type_name == "rcl_interfaces::srv::dds_::GetParameters_Request_"
    assert reply.type_name == "rcl_interfaces::srv::dds_::GetParameters_Response_"
    assert request.user_data["serviceid"] == reply.user_data["serviceid"]
    assert reply.user_data["typehash"].startswith("RIHS01_")


def test_participants_with_range_off_meet_nobody_else(domain):
    with (
        Participant(domain, reach=DiscoveryRange("OFF")) as alone,
        Child(LISTENER, domain) as child,
    ):
        assert child.process.stdout.readline() == "ready\n"
        graph = Graph(alone)
        assert graph.nodes() == []
        assert graph.endpoints("rt/ping") == []


def test_all_policies_reach_the_other_side(participant, neighbour, bell):
    asked = EndpointQos(
        durability=EndpointQos.TRANSIENT_LOCAL,
        history=EndpointQos.KEEP_ALL,
        depth=0,
        deadline=2_000_000_000,
        lifespan=3_000_000_000,
        liveliness=EndpointQos.MANUAL_BY_TOPIC,
        liveliness_lease_duration=4_000_000_000,
    )
    writer = participant.create_writer("rt/policies", STRING, asked)
    graph = Graph(neighbour)
    bell.wait_until(lambda: graph.endpoints("rt/policies"))
    assert graph.endpoints("rt/policies")[0].qos == asked
    assert writer.qos == asked


@pytest.mark.usefixtures("participant")
def test_one_process_cannot_reach_two_ways_in_a_domain(domain):
    with pytest.raises(DdsError, match="discovery range LOCALHOST"):
        Participant(domain, reach=DiscoveryRange("SUBNET"))


@pytest.mark.parametrize("number", [-1, 233])
def test_a_domain_that_does_not_exist_is_refused(number):
    with pytest.raises(DdsError, match="not one of 0 to 232"):
        Participant(number, reach=LOCALHOST)


def test_the_environment_decides_the_discovery_range():
    assert DiscoveryRange.from_environment({}) == DiscoveryRange("SUBNET")
    assert DiscoveryRange.from_environment({"ROS_LOCALHOST_ONLY": "1"}).name == "LOCALHOST"
    environment = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF", "ROS_LOCALHOST_ONLY": "0"}
    assert DiscoveryRange.from_environment(environment).name == "OFF"
    with pytest.raises(MiddlewareError, match="SUBNET, LOCALHOST, OFF, SYSTEM_DEFAULT"):
        DiscoveryRange.from_environment({"ROS_AUTOMATIC_DISCOVERY_RANGE": "localhost"})


def test_the_configuration_follows_the_discovery_range():
    localhost = DiscoveryRange("LOCALHOST", ("pc<2>",)).configuration()
    assert "address='127.0.0.1'" in localhost
    assert "<AllowMulticast>false</AllowMulticast>" in localhost
    assert "<Peer address='localhost'/><Peer address='pc&lt;2&gt;'/>" in localhost
    subnet = DiscoveryRange("SUBNET", ("10.0.0.5",)).configuration()
    assert "<Peers><Peer address='10.0.0.5'/></Peers>" in subnet
    assert "AllowMulticast" not in subnet
    off = DiscoveryRange("OFF", ("10.0.0.5",)).configuration()
    assert f"<Tag>ros_discovery_off_{os.getpid()}</Tag>" in off
    assert "Peer" not in off
    assert "Participant" not in DiscoveryRange("SYSTEM_DEFAULT", ("a",)).configuration()


def profile(**changes):
    values = {
        "reliability": 1,
        "durability": 2,
        "history": 1,
        "depth": 10,
        "deadline": SimpleNamespace(nanoseconds=0),
        "lifespan": SimpleNamespace(nanoseconds=0),
        "liveliness": 0,
        "liveliness_lease_duration": SimpleNamespace(nanoseconds=2**63 - 1),
    }
    return SimpleNamespace(**values | changes)


def test_a_profile_of_rclpys_becomes_policies():
    assert qos_of_profile(profile()) == EndpointQos()
    system = profile(reliability=0, durability=0, history=0, depth=0)
    assert qos_of_profile(system) == EndpointQos(depth=1)
    timed = profile(deadline=SimpleNamespace(nanoseconds=5), history=2, liveliness=3)
    assert qos_of_profile(timed) == EndpointQos(deadline=5, history=2, liveliness=3)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"reliability": 3}, "reliability policy 3 cannot be asked for"),
        ({"durability": 3}, "durability policy 3 cannot be asked for"),
        ({"history": 3}, "history policy 3 cannot be asked for"),
        ({"liveliness": 4}, "liveliness policy 4 cannot be asked for"),
        ({"reliability": 4}, "reliability policy 4 cannot be asked for"),
        ({"depth": -1}, "depth of -1"),
    ],
)
def test_an_unknown_policy_is_refused(changes, sentence):
    with pytest.raises(MiddlewareError, match=sentence):
        qos_of_profile(profile(**changes))


def test_a_loopback_without_ipv4_is_named():
    program = "import us_sim.nodes, rclpy; rclpy.init()"
    isolated = ["unshare", "-rn", sys.executable, "-c", program]
    if shutil.which("unshare") is None or subprocess.run(["unshare", "-rn", "true"]).returncode:
        pytest.skip("no network namespaces here")
    ran = subprocess.run(isolated, capture_output=True, text=True, check=False)
    assert "IPv4" in ran.stderr
