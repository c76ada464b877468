"""Serialized samples over DDS, between participants and between processes."""

import array
import os
import signal
import time

import pytest

pytest.importorskip("cyclonedds", reason="the transport needs pip install cyclonedds")

from transport_bench import (
    BEST_EFFORT,
    HELLO,
    IMAGE,
    LATCHED,
    LISTENER,
    LOCALHOST,
    RELIABLE,
    STRING,
    Child,
    take_one,
)

from us_sim.standalone.cdr import deserialize, serialize
from us_sim.standalone.ddsc import EndpointQos
from us_sim.standalone.graph import Graph
from us_sim.standalone.messages import message_class
from us_sim.standalone.transport import DdsError, Participant

ECHO = """
import sys, threading
from us_sim.standalone.ddsc import EndpointQos
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
from us_sim.standalone.ddsc import EndpointQos
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
