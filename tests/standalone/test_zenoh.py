"""Nodes over zenoh, against sessions that do by hand what rmw_zenoh_cpp does."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from us_sim.standalone import middleware
from us_sim.standalone.cdr import serialize
from us_sim.standalone.messages import message_class
from us_sim.standalone.middleware import (
    CYCLONE,
    ZENOH,
    EndpointQos,
    GraphNode,
    MiddlewareError,
    Owner,
    implementation,
)

zenoh = pytest.importorskip("zenoh", reason="eclipse-zenoh is not installed")

from zenoh import ext  # noqa: E402

from us_sim.standalone.zenoh_config import open_session  # noqa: E402
from us_sim.standalone.zenoh_names import (  # noqa: E402
    Entity,
    attachment,
    read_attachment,
    read_token,
)
from us_sim.standalone.zenoh_session import Zenoh  # noqa: E402

DOMAIN = 42
STRING_KEY = (
    f"{DOMAIN}/us/text/std_msgs::msg::dds_::String_/"
    "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
)
TRIGGER_HASH = "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f"
TRIGGER_KEY = f"{DOMAIN}/us/go/std_srvs::srv::dds_::Trigger_/{TRIGGER_HASH}"
QOS, LATCHED = EndpointQos(), EndpointQos(depth=1, durability=EndpointQos.TRANSIENT_LOCAL)
HELLO = serialize(message_class("std_msgs/msg/String")(data="hello"))
PROBE = Owner(1001, "/us", "probe")
TEXT = ("/us/text", "std_msgs/msg/String")
GO = ("/us/go", "std_srvs/srv/Trigger")


def nothing(_: str) -> None:
    """Nothing is incompatible."""


def until(condition: Callable[[], Any], seconds: float = 10.0) -> Any:
    """Wait for a condition, and return what it says."""
    end = time.monotonic() + seconds
    while not (said := condition()):
        assert time.monotonic() < end, "what was waited for did not happen"
        time.sleep(0.005)
    return said


@pytest.fixture(autouse=True)
def _own_router(monkeypatch) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")


@pytest.fixture
def ours() -> Iterator[Zenoh]:
    context = Zenoh(DOMAIN, "/")
    yield context
    context.close()


@pytest.fixture
def raw(ours) -> Iterator[Any]:  # noqa: ARG001 (it has the router)
    session = open_session()
    yield session
    session.close()


def test_samples_have_the_key_the_bytes_and_the_attachment_of_rmw_zenoh(ours, raw):
    samples: list[Any] = []
    subscriber = raw.declare_subscriber(STRING_KEY, samples.append)
    writer = ours.create_publisher(PROBE, *TEXT, QOS, nothing)
    until(lambda: writer.write(HELLO) and len(samples) > 1)
    first, second = samples[:2]
    assert str(first.key_expr) == STRING_KEY
    assert first.payload.to_bytes() == HELLO
    (number, sent, gid), (next_number, *_) = (
        read_attachment(sample.attachment.to_bytes()) for sample in (first, second)
    )
    assert next_number == number + 1
    assert abs(sent - time.time_ns()) < 60e9
    known = f"@ros2_lv/{DOMAIN}/*/1001/*/MP/**"  # a token may come later than a sample
    (token,) = until(lambda: [str(each.ok.key_expr) for each in raw.liveliness().get(known)])
    assert gid == read_token(token).gid
    assert token.split("/")[5:] == [
        *("MP", "%", "%us", "probe", "%us%text"),
        *(*STRING_KEY.split("/")[3:], "::,10:,:,:,,"),
    ]
    subscriber.undeclare()


def test_a_sample_of_rmw_zenoh_is_received_with_its_time(ours, raw):
    reader = ours.create_subscription(PROBE, *TEXT, QOS, nothing)
    publisher = raw.declare_publisher(STRING_KEY)
    publisher.put(b"without an attachment it is none of ROS")

    def taken():
        publisher.put(HELLO, attachment=attachment(7, 123_456_789, bytes(16)))
        return reader.take()

    data, info = until(taken)
    assert data == HELLO
    assert (info.source_timestamp, info.sequence) == (123_456_789, 7)
    assert info.received_timestamp > info.source_timestamp


def test_a_request_of_rmw_zenoh_is_answered_with_its_own_number(ours, raw):
    server = ours.create_service(PROBE, *GO, QOS)
    querier = raw.declare_querier(
        TRIGGER_KEY,
        target=zenoh.QueryTarget.ALL_COMPLETE,
        consolidation=zenoh.ConsolidationMode.NONE,
    )
    until(lambda: querier.matching_status)
    time.sleep(0.2)  # for the link between the two to carry what the router told of
    request = serialize(message_class("std_srvs/srv/Trigger_Request")())
    response = serialize(message_class("std_srvs/srv/Trigger_Response")(message="done"))
    gid = bytes(range(16))
    replies = querier.get(payload=request, attachment=attachment(5, 1, gid))
    data, header = until(server.take)
    assert (data, header.client, header.sequence) == (request, gid, 5)
    assert server.send_response(response, header)
    assert not server.send_response(response, header)
    (reply,) = list(replies)
    assert reply.ok.payload.to_bytes() == response
    number, sent, repeated = read_attachment(reply.ok.attachment.to_bytes())
    assert (number, repeated) == (5, gid)
    assert abs(sent - time.time_ns()) < 60e9


def test_a_hundred_requests_may_wait_for_their_answers(ours, raw):
    server = ours.create_service(PROBE, *GO, EndpointQos(depth=500))
    told: list[str] = []
    server.on_unanswered = told.append
    querier = raw.declare_querier(TRIGGER_KEY, target=zenoh.QueryTarget.ALL_COMPLETE)

    def ask(number):
        return querier.get(payload=b"", attachment=attachment(number, 1, bytes(16)))

    number = iter(range(500))
    open_requests = [until(lambda: ask(next(number)) and server.take())[1]]
    replies = [ask(1000 + each) for each in range(120)]
    while open_requests[-1].sequence != 1119:
        open_requests.append(until(server.take)[1])
    given_up = len(open_requests) - 100
    until(lambda: len(told) == given_up)
    answered = [server.send_response(b"done", each) for each in open_requests]
    assert answered == [False] * given_up + [True] * 100
    assert [len(list(each)) for each in replies[-100:]] == [1] * 100


def test_a_service_of_rmw_zenoh_is_found_and_called(ours, raw):
    client = ours.create_client(PROBE, *GO, QOS)
    assert not client.service_is_ready()
    response = serialize(message_class("std_srvs/srv/Trigger_Response")(message="done"))

    def answer(query):
        number, _, gid = read_attachment(query.attachment.to_bytes())
        with query:
            query.reply(TRIGGER_KEY, response, attachment=attachment(number, 9, gid))

    queryable = raw.declare_queryable(TRIGGER_KEY, answer, complete=True)
    server = Entity(
        DOMAIN,
        str(raw.info.zid()),
        *(0, 1, "SS", "/", "/us", "there", "/us/go"),
        *("std_srvs::srv::dds_::Trigger_", TRIGGER_HASH, QOS),
    )
    token = raw.liveliness().declare_token(server.token)
    until(client.service_is_ready)
    sequence = client.send_request(serialize(message_class("std_srvs/srv/Trigger_Request")()))
    data, header = until(client.take)
    assert (data, header.sequence, header.info.source_timestamp) == (response, sequence, 9)
    token.undeclare()
    until(lambda: not client.service_is_ready())
    queryable.undeclare()


def test_a_request_is_sent_again_until_the_service_can_be_reached(ours, raw):
    """Its token may come before the link that carries requests."""
    client = ours.create_client(PROBE, *GO, QOS)
    service = ("SS", "/", "/us", "there", "/us/go", "std_srvs::srv::dds_::Trigger_", TRIGGER_HASH)
    there = Entity(DOMAIN, str(raw.info.zid()), 0, 1, *service)
    token = raw.liveliness().declare_token(there.token)
    until(client.service_is_ready)
    sequence = client.send_request(b"ask")
    time.sleep(0.3)
    asked: list[Any] = []

    def answer(query):
        asked.append(query.payload.to_bytes())
        with query:
            query.reply(TRIGGER_KEY, b"told", attachment=query.attachment)

    queryable = raw.declare_queryable(TRIGGER_KEY, answer, complete=True)
    data, header = until(client.take)
    assert (data, header.sequence, asked) == (b"told", sequence, [b"ask"])
    token.undeclare()
    queryable.undeclare()


def test_latched_samples_reach_who_comes_later(ours, raw):
    writer = ours.create_publisher(PROBE, *TEXT, LATCHED, nothing)
    writer.write(HELLO)
    samples: list[Any] = []
    ext.declare_advanced_subscriber(
        raw,
        STRING_KEY,
        samples.append,
        history=ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
        recovery=ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
        subscriber_detection=True,
    )
    assert until(lambda: samples)[0].payload.to_bytes() == HELLO
    writer.close()


def test_latched_samples_of_rmw_zenoh_reach_us_later(ours, raw):
    publisher = ext.declare_advanced_publisher(
        raw,
        STRING_KEY,
        cache=ext.CacheConfig(1),
        publisher_detection=True,
        sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5),
    )
    publisher.put(b"old", attachment=attachment(1, 1, bytes(16)))
    publisher.put(HELLO, attachment=attachment(2, 2, bytes(16)))
    volatile = ours.create_subscription(PROBE, *TEXT, QOS, nothing)
    reader = ours.create_subscription(PROBE, *TEXT, LATCHED, nothing)
    assert until(reader.take)[0] == HELLO
    assert reader.take() is None
    assert volatile.take() is None
    publisher.undeclare()


def test_a_node_of_rmw_zenoh_is_in_the_graph_as_long_as_it_lives(ours, raw):
    session = str(raw.info.zid())
    node = Entity(DOMAIN, session, 3, 3, "NN", "/", "/us", "there")
    topic = ("/us/text", "std_msgs::msg::dds_::String_", STRING_KEY.split("/")[-1])
    listener = Entity(DOMAIN, session, 3, 4, "MS", "/", "/us", "there", *topic, LATCHED)
    other_domain = Entity(DOMAIN + 1, session, 3, 3, "NN", "/", "/us", "elsewhere")
    tokens = [raw.liveliness().declare_token(each.token) for each in (node, listener, other_domain)]
    writer = ours.create_publisher(PROBE, *TEXT, QOS, nothing)
    until(writer.matched_count)
    ours.announce([GraphNode("/us", "probe", number=PROBE.number)])
    here, there = until(lambda: len(ours.nodes()) == 2 and ours.nodes())
    assert (here.name, there.namespace, there.name) == ("probe", "/us", "there")
    endpoints = {endpoint.is_writer: endpoint for endpoint in ours.endpoints("rt/us/text")}
    assert endpoints[False].gid == there.reader_gids[0] == listener.gid
    assert endpoints[False].qos == LATCHED
    assert [writer.gids[1][0]] == [endpoints[True].gid]
    for token in tokens:
        token.undeclare()
    until(lambda: len(ours.nodes()) == 1 and not writer.matched_count())


def test_what_is_destroyed_is_gone_for_others(ours, raw):
    def kinds():
        replies = raw.liveliness().get(f"@ros2_lv/{DOMAIN}/**")
        return sorted(read_token(str(reply.ok.key_expr)).kind for reply in replies)

    made = [
        ours.create_publisher(PROBE, *TEXT, QOS, nothing),
        ours.create_subscription(PROBE, *TEXT, QOS, nothing),
        ours.create_client(PROBE, *GO, QOS),
        ours.create_service(PROBE, *GO, QOS),
    ]
    ours.announce([GraphNode("/us", "probe", number=PROBE.number)])
    until(lambda: kinds() == ["MP", "MS", "NN", "SC", "SS"])
    for endpoint in made:
        endpoint.close()
        endpoint.close()
    ours.announce([])
    until(lambda: kinds() == [])
    with pytest.raises(MiddlewareError, match="the writer is closed"):
        made[0].write(HELLO)
    assert made[0].matched_count() == made[1].matched_count() == 0
    assert made[1].take() is None


def test_the_newest_are_kept_and_all_of_them_where_asked(ours):
    last = ours.create_subscription(PROBE, *TEXT, EndpointQos(depth=2), nothing)
    all_kept = EndpointQos(history=EndpointQos.KEEP_ALL)
    everything = ours.create_subscription(PROBE, *TEXT, all_kept, nothing)
    writer = ours.create_publisher(PROBE, *TEXT, all_kept, nothing)
    for number in range(20):
        writer.write(bytes([number]))
    received: list[int] = []
    until(
        lambda: ((sample := everything.take()) and received.append(sample[0][0])) or received[19:]
    )
    assert received == list(range(20))
    until(lambda: len(last._waiting) == 2)
    assert [last.take()[0][0], last.take()[0][0], last.take()] == [18, 19, None]


def test_messages_of_all_sizes_arrive_as_they_were_sent(ours, raw):
    samples: list[Any] = []
    raw.declare_subscriber(STRING_KEY, samples.append)
    writer = ours.create_publisher(PROBE, *TEXT, QOS, nothing)
    until(lambda: writer.write(HELLO) and samples)
    for size in (1, 1343, 65_499, 65_537, 1_048_576, 3_000_001):
        data = os.urandom(size)
        writer.write(data)
        until(lambda data=data: samples[-1].payload.to_bytes() == data)


def test_closing_from_a_callback_does_not_deadlock():
    context = Zenoh(DOMAIN, "/")
    reader = context.create_subscription(PROBE, *TEXT, QOS, nothing)
    closed: list[bool] = []

    def close():
        if reader.take() is not None:
            context.close()
            closed.append(True)

    reader.set_on_data(close)
    context.create_publisher(PROBE, *TEXT, QOS, nothing).write(HELLO)
    until(lambda: closed)
    with pytest.raises(MiddlewareError, match="the context is closed"):
        context.create_subscription(PROBE, *TEXT, QOS, nothing)


# Without being asked it says when it is up; at each line it names the nodes that it knows. It ends
# without closing anything.
MEMBER = """
import sys
from us_sim.standalone.middleware import GraphNode, connect
me = connect(int(sys.argv[1]), "/")
me.announce([GraphNode("/", sys.argv[2], number=1)])
print("up", flush=True)
for line in sys.stdin:
    print(" ".join(sorted(node.name for node in me.nodes())), flush=True)
"""


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Member:
    """A process with a node in the domain, and a router on the last port if it is the first one."""

    def __init__(self, name: str, *ports: int) -> None:
        routers = json.dumps([f"tcp/127.0.0.1:{port}" for port in ports])
        self.process = subprocess.Popen(
            [sys.executable, "-c", MEMBER, str(DOMAIN), name],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ
            | {
                "RMW_IMPLEMENTATION": ZENOH,
                "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
                "ZENOH_CONFIG_OVERRIDE": f"connect/endpoints={routers}",
            },
        )
        assert self.process.stdout.readline() == "up\n"

    def sees(self) -> list[str]:
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        return self.process.stdout.readline().split()


@pytest.mark.parametrize("way", [signal.SIGTERM, signal.SIGKILL])
def test_another_process_takes_the_router_over_when_its_process_ends(way):
    port = free_port()
    members = [Member(name, port) for name in ("first", "second", "third")]
    try:
        until(lambda: all(m.sees() == ["first", "second", "third"] for m in members))
        members[0].process.send_signal(way)
        members[0].process.wait(10)
        until(lambda: all(m.sees() == ["second", "third"] for m in members[1:]))
        members.append(Member("fourth", port))
        until(lambda: all(m.sees() == ["fourth", "second", "third"] for m in members[1:]))
        for member in members[1:]:
            member.process.communicate(timeout=20)
            assert member.process.returncode == 0
    finally:
        for member in members:
            member.process.kill()
            member.process.communicate()


def test_the_router_of_rmw_zenoh_may_start_later():
    theirs = free_port()
    member = Member("first", theirs, free_port())
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", f'["tcp/127.0.0.1:{theirs}"]')
    router = zenoh.open(config)
    until(lambda: list(router.info.peers_zid()))
    router.close()
    member.process.communicate(timeout=20)


def test_a_session_with_range_off_meets_nobody(ours, monkeypatch):
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
    monkeypatch.delenv("ZENOH_CONFIG_OVERRIDE", raising=False)
    alone = Zenoh(DOMAIN, "/")
    ours.announce([GraphNode("/", "other", number=1)])
    time.sleep(0.5)
    assert alone.nodes() == []
    alone.close()


@pytest.mark.parametrize(
    ("variables", "sentence"),
    [
        ({"ZENOH_CONFIG_OVERRIDE": "no/such/key=1"}, "ZENOH_CONFIG_OVERRIDE has 'no/such/key=1'"),
        ({"ZENOH_SESSION_CONFIG_URI": "/no/file.json5"}, "ZENOH_SESSION_CONFIG_URI is /no/file"),
        ({"ZENOH_CONFIG_OVERRIDE": 'listen/endpoints=["tcp/1.2.3.4:1"]'}, "no zenoh session"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "MARS"}, "'MARS'; set it to one of SUBNET"),
    ],
)
def test_an_environment_that_cannot_be_followed_is_named(variables, sentence):
    with pytest.raises(MiddlewareError, match=sentence):
        open_session({"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"} | variables)


def test_a_file_of_configuration_is_followed(tmp_path):
    file = tmp_path / "session.json5"
    content = {"mode": "peer", "id": "abcdef", "scouting": {"multicast": {"enabled": False}}}
    file.write_text(json.dumps(content | {"listen": {"endpoints": []}}))
    session = open_session({"ZENOH_SESSION_CONFIG_URI": str(file)})
    assert str(session.info.zid()) == "abcdef"
    session.close()


def test_the_environment_chooses_the_middleware(monkeypatch):
    assert implementation({"RMW_IMPLEMENTATION": ZENOH}) == ZENOH
    with pytest.raises(MiddlewareError, match="'rmw_fastrtps_cpp', but without ROS 2 there are"):
        implementation({"RMW_IMPLEMENTATION": "rmw_fastrtps_cpp"})

    def without(*names):
        def tried(name):
            if name in names:
                raise MiddlewareError(f"no {name}")

        monkeypatch.setattr(middleware, "_import", tried)

    without()
    assert implementation({}) == CYCLONE
    without(CYCLONE)
    assert implementation({"RMW_IMPLEMENTATION": ""}) == ZENOH
    with pytest.raises(MiddlewareError, match=f"no {CYCLONE}$"):
        implementation({"RMW_IMPLEMENTATION": CYCLONE})
    without(CYCLONE, ZENOH)
    with pytest.raises(MiddlewareError, match=f"no {CYCLONE}; no {ZENOH}"):
        implementation({})


@pytest.mark.parametrize("number", [-1, 233])
def test_a_domain_that_does_not_exist_is_refused(number):
    with pytest.raises(MiddlewareError, match="not one of 0 to 232"):
        Zenoh(number, "/")
