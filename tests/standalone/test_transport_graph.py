"""Who is in a domain, and services, between participants and between processes."""

import pytest

pytest.importorskip("cyclonedds", reason="the transport needs pip install cyclonedds")

from transport_bench import IMAGE, LATCHED, LISTENER, RELIABLE, STRING, Child

from us_sim.standalone.cdr import deserialize, serialize
from us_sim.standalone.ddsc import EndpointQos
from us_sim.standalone.graph import Graph, GraphNode
from us_sim.standalone.messages import service_class
from us_sim.standalone.services import ServiceClient, ServiceServer
from us_sim.standalone.transport import DiscoveryRange, Participant


def test_the_graph_shows_nodes_and_endpoints_of_other_processes(participant, domain, bell):
    graph = Graph(participant)
    writer = participant.create_writer("rt/ping", IMAGE, LATCHED)
    graph.announce([GraphNode("/", "here", writer_gids=(writer.gid,))])
    with Child(LISTENER, domain):
        bell.wait_until(lambda: len(graph.nodes()) == 2 and len(graph.endpoints("rt/ping")) == 2)
        here, there = graph.nodes()
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
    bell.wait_until(lambda: not graph.nodes() and not graph.endpoints("rt/ping"), 2.0)
    assert child.process.communicate() == ("ready\n", "")


def test_a_service_answers_its_client(participant, neighbour, bell):
    SetBool = service_class("std_srvs/srv/SetBool")
    client = ServiceClient(neighbour, "/node/set", "std_srvs/srv/SetBool", RELIABLE)
    other = ServiceClient(neighbour, "/node/set", "std_srvs/srv/SetBool", RELIABLE)
    assert not client.service_is_ready()
    server = ServiceServer(participant, "/node/set", "std_srvs/srv/SetBool", RELIABLE)
    client.set_on_data(bell.ring)
    bell.wait_until(client.service_is_ready)

    def answer():
        while (taken := server.take()) is not None:
            request = deserialize(taken[0], SetBool.Request)
            response = SetBool.Response(success=not request.data, message="ünïcode")
            assert server.send_response(serialize(response), taken[1])

    server.set_on_data(answer)
    numbers = [client.send_request(serialize(SetBool.Request(data=data))) for data in (True, False)]
    received = []

    def both_came():
        while (taken := client.take()) is not None:
            received.append(taken)
        return len(received) == 2

    bell.wait_until(both_came)
    assert [header.sequence for _, header in received] == numbers
    responses = [deserialize(data, SetBool.Response) for data, _ in received]
    assert [response.success for response in responses] == [False, True]
    assert responses[0].message == "ünïcode"
    assert other.take() is None
    server.close()
    bell.wait_until(lambda: not client.service_is_ready())


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
