"""OpenIGTLink against pyigtl's server and client, and against what no server should send."""

import socket
import struct
import time
from types import SimpleNamespace

import numpy as np
import pyigtl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from igtl_peers import PlainServer, free_port, pyigtl_server, wait_until
from pyigtl.messages import CRC64, MessageBase

from us_sim.errors import TrackingError
from us_sim.tracking.openigtlink import (
    HEADER,
    OpenIGTLinkClient,
    OpenIGTLinkServer,
    pack_image,
    pack_transform,
    parse_header,
    parse_poses,
)
from us_sim.tracking.settings import OpenIGTLinkSettings

MATRIX = np.array([[0.0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1]])  # mm
STAMP = 1_700_000_000_250_000_000  # ns


@pytest.fixture
def listen():
    """Connects a client and keeps what it says; closed after the test."""
    clients = []

    def connect(port, body="ProbeToTracker", **settings):
        heard = SimpleNamespace(measurements=[], problems=[])
        heard.client = OpenIGTLinkClient(
            OpenIGTLinkSettings(host="127.0.0.1", port=port, **settings),
            body,
            heard.measurements.append,
            lambda kind, sentence: heard.problems.append((kind, sentence)),
        )
        clients.append(heard.client)
        return heard

    yield connect
    for client in clients:
        client.close()


@pytest.fixture
def plain():
    server = PlainServer()
    yield server
    server.close()


def message(kind, body, device="ProbeToTracker", version=1, stamp=(1, 2**31), checksum=0):
    numbers = *stamp, len(body), checksum
    return HEADER.pack(version, kind.encode(), device.encode(), *numbers) + body


def columns(matrix):
    """A transform's twelve numbers on the wire."""
    return matrix[:3].T.astype(">f4").tobytes()


def version_2(status):
    """A transform of version 2 with a status of the tracker."""
    said = b"TransformStatus" + status
    head, meta = (
        struct.pack(">HHII", 12, 10, len(said), 5),
        struct.pack(">HHHI", 1, 15, 3, len(status)),
    )
    return message("TRANSFORM", head + columns(MATRIX) + meta + said, version=2)


@pytest.mark.parametrize(("settings", "signs"), [({}, [1, 1, 1]), ({"world": "ras"}, [-1, -1, 1])])
def test_a_transform_of_pyigtl_comes_as_metres_in_lps_with_its_stamp(listen, settings, signs):
    with pyigtl_server() as server:
        heard = listen(server.server_address[1], **settings)
        wait_until(server.is_connected)
        sent = pyigtl.TransformMessage(MATRIX, timestamp=STAMP * 1e-9, device_name="ProbeToTracker")
        server.send_message(sent)
        wait_until(lambda: heard.measurements)
    (measurement,) = heard.measurements
    expected = np.diag(signs) @ MATRIX[:3]
    np.testing.assert_allclose(measurement.pose.position, 1e-3 * expected[:, 3], atol=1e-8)
    np.testing.assert_allclose(measurement.pose.rotation, expected[:, :3], atol=1e-7)
    assert abs(measurement.stamp - STAMP) < 1000


def test_a_server_that_goes_away_and_comes_back_is_found_again(listen):
    port = free_port()
    heard = listen(port)
    wait_until(lambda: heard.problems)
    assert heard.problems[0][0] == "connection"
    assert f"127.0.0.1:{port}" in heard.problems[0][1]
    for times in (1, 2):
        with pyigtl_server(port) as server:
            wait_until(server.is_connected)
            server.send_message(pyigtl.TransformMessage(MATRIX, device_name="ProbeToTracker"))
            wait_until(lambda times=times: len(heard.measurements) == times)


def test_the_body_is_chosen_among_others_and_said_when_it_is_not_there(listen, plain):
    heard = listen(plain.port, "StylusToReference")
    connection = plain.accept()
    others = message("TRANSFORM", columns(MATRIX), "ProbeToReference")
    for _ in range(300):
        connection.sendall(others)
        if heard.problems:
            break
        time.sleep(0.01)
    ((kind, said),) = heard.problems
    assert kind == "body"
    for each in (
        f"127.0.0.1:{plain.port}",
        "StylusToReference",
        "tracker.body",
        "ProbeToReference",
    ):
        assert each in said
    connection.sendall(message("TRANSFORM", columns(MATRIX), "StylusToReference"))
    wait_until(lambda: heard.measurements)


TOOL = b"ProbeToTracker".ljust(20, b"\0") + b"\x02\0"


@pytest.mark.parametrize(
    "sent",
    [
        message("TRANSFORM", columns(MATRIX)),
        message("TDATA", b"Other".ljust(22, b"\0") + columns(np.eye(4)) + TOOL + columns(MATRIX)),
        version_2(b"OK"),
        message("TRANSFORM", columns(MATRIX), checksum=CRC64(columns(MATRIX))),
    ],
    ids=["transform", "tdata", "version 2", "checksum"],
)
def test_every_kind_of_pose_is_understood(listen, plain, sent):
    heard = listen(plain.port)
    plain.accept().sendall(message("IMAGE", bytes(200_000)) + sent)
    wait_until(lambda: heard.measurements)
    (measurement,) = heard.measurements
    np.testing.assert_allclose(measurement.pose.position, [0.01, 0.02, 0.03], atol=1e-8)
    np.testing.assert_allclose(measurement.pose.rotation, MATRIX[:3, :3], atol=1e-6)
    assert measurement.stamp == 1_500_000_000
    assert heard.problems == []


@pytest.mark.parametrize(
    ("sent", "kind", "word"),
    [
        (message("TRANSFORM", columns(MATRIX), checksum=1), "message", "checksum"),
        (message("TRANSFORM", columns(0 * MATRIX)), "pose", "not rigid"),
        (message("TRANSFORM", columns(0.2 * MATRIX)), "pose", "not rigid"),
        (message("TRANSFORM", b"short"), "message", "5 bytes"),
        (message("TRANSFORM", columns(np.nan * MATRIX)), "pose", "finite"),
        (message("TRANSFORM", b"", version=2), "message", "0 bytes"),
        (message("TRANSFORM", b"\xff" * 30, version=3), "message", "30 bytes"),
        (version_2(b"MISSING"), "message", "MISSING"),
    ],
)
def test_what_is_no_pose_is_said_and_survived(listen, plain, sent, kind, word):
    heard = listen(plain.port)
    plain.accept().sendall(sent + message("TRANSFORM", columns(MATRIX)))
    wait_until(lambda: heard.measurements)
    ((said, text),) = heard.problems
    assert said == kind
    assert word in text


@pytest.mark.parametrize(
    ("stamps", "clock", "taken", "problems"),
    [
        ([1, 2, 3], "server", 3, []),
        ([1, 1, 2], "server", 2, ["clock"]),  # as of servers that stamp by whole seconds
        ([1, 1, 2], "arrival", 3, []),
        ([0, 0, 0], "server", 3, []),
    ],
)
def test_moving_poses_are_no_repeats(listen, plain, stamps, clock, taken, problems):
    heard = listen(plain.port, clock=clock)
    connection = plain.accept()
    for number, second in enumerate(stamps):
        moved = MATRIX + np.eye(4, k=3) * number
        connection.sendall(message("TRANSFORM", columns(moved), stamp=(second, 0)))
    wait_until(lambda: len(heard.measurements) == taken and len(heard.problems) == len(problems))
    assert [kind for kind, _ in heard.problems] == problems
    assert all("clock" in said and "arrival" in said for _, said in heard.problems)


@pytest.mark.parametrize("clock", ["server", "arrival"])
def test_an_equal_stamp_and_an_equal_matrix_are_a_repeat(listen, plain, clock):
    heard = listen(plain.port, clock=clock)
    connection = plain.accept()
    for stamp in ((1, 0), (1, 0), (2, 0)):
        connection.sendall(message("TRANSFORM", columns(MATRIX), stamp=stamp))
    wait_until(lambda: len(heard.measurements) == 2)
    assert [m.stamp for m in heard.measurements] == [10**9, 2 * 10**9]
    assert [kind for kind, _ in heard.problems] == ["repeated"]


@settings(max_examples=25, deadline=None)
@given(
    data=st.binary(max_size=300),
    kind=st.sampled_from(["TRANSFORM", "TDATA"]),
    version=st.sampled_from([1, 2, 3]),
)
def test_any_body_is_poses_or_a_sentence(data, kind, version):
    header = parse_header(message(kind, data, version=version)[: HEADER.size])
    try:
        poses = parse_poses(header, data)
    except TrackingError:
        return
    assert all(matrix.shape == (4, 4) for _, matrix in poses)


@pytest.mark.parametrize(
    "sent",
    [
        b"HTTP/1.1 400 Bad Request\r\n".ljust(HEADER.size, b"-"),
        message("TRANSFORM", b"")[:-16] + struct.pack(">QQ", 2**60, 0),
        message("TRANSFORM", columns(MATRIX))[:-5],
    ],
    ids=["another protocol", "a body without end", "a cut message"],
)
def test_a_stream_that_cannot_be_is_left_and_tried_again(listen, plain, sent):
    heard = listen(plain.port)
    connection = plain.accept()
    connection.sendall(sent)
    connection.close()
    wait_until(lambda: heard.problems)
    assert heard.problems[0][0] == "connection"
    plain.accept().sendall(message("TRANSFORM", columns(MATRIX)))
    wait_until(lambda: heard.measurements)


def test_tracking_data_are_asked_for(listen, plain):
    listen(plain.port, tracking_data=True)
    connection = plain.accept()
    connection.settimeout(20.0)
    data = b""
    while len(data) < HEADER.size + 36:
        data += connection.recv(1000)
    header = parse_header(data[: HEADER.size])
    assert (header.kind, header.size) == ("STT_TDATA", 36)
    assert struct.unpack(">I", data[HEADER.size : HEADER.size + 4]) == (10,)


def test_what_we_send_is_what_pyigtl_reads_and_its_checksum_holds():
    pixels = np.arange(12, dtype=np.uint8).reshape(3, 4)
    place = np.array([[0, 2e-4, 0, 0.01], [0, 0, 1e-3, 0.02], [1e-4, 0, 0, 0.03], [0, 0, 0, 1]])
    for data in (
        pack_image("Image_Reference", STAMP, pixels, place, "lps"),
        pack_transform("ProbeToReference", STAMP, np.diag([1.0, 1, 1, 1])),
    ):
        head, body = data[: HEADER.size], data[HEADER.size :]
        assert CRC64(body) == HEADER.unpack(head)[-1]
        fields = MessageBase.parse_header(head)
        assert fields["timestamp"] == pytest.approx(STAMP * 1e-9, abs=1e-6)
        read = MessageBase.create_message(fields["message_type"])
        read.unpack(fields, body)
        if fields["message_type"] == "IMAGE":
            np.testing.assert_array_equal(read.image, pixels[None])
            expected = np.diag([1e3, 1e3, 1e3, 1]) @ place
            np.testing.assert_allclose(read.ijk_to_world_matrix, expected, atol=1e-4)
            assert read.world_coordinate_system == "lps"


def test_pyigtls_client_receives_the_newest_from_our_server():
    server = OpenIGTLinkServer("127.0.0.1", 0)
    client = pyigtl.OpenIGTLinkClient("127.0.0.1", server.port)
    try:
        wait_until(lambda: server.client_count == 1)
        for number in range(50):
            matrix = np.eye(4)
            matrix[0, 3] = number * 1e-3
            server.send_message("A", pack_transform("A", STAMP, matrix))
        received = []

        def newest_came():
            received.extend(client.get_latest_messages())
            return received and received[-1].matrix[0, 3] == 49.0

        wait_until(newest_came)
    finally:
        client.stop()
    wait_until(lambda: server.client_count == 0)
    server.close()


def test_a_client_that_does_not_read_holds_nobody_up():
    server = OpenIGTLinkServer("127.0.0.1", 0)
    image = pack_image("I", STAMP, np.zeros((1000, 1000), np.uint8), np.eye(4), "ras")
    with socket.create_connection(("127.0.0.1", server.port)):
        reader = pyigtl.OpenIGTLinkClient("127.0.0.1", server.port)
        wait_until(lambda: server.client_count == 2)
        try:
            for number in range(30):
                server.send_message("I", image)
                server.send_message("N", pack_transform(f"N{number}", STAMP, np.eye(4)))
            wait_until(lambda: any(m.device_name == "N29" for m in reader.get_latest_messages()))
        finally:
            reader.stop()
    server.close()


def test_a_port_in_use_says_so():
    server = OpenIGTLinkServer("127.0.0.1", 0)
    with pytest.raises(TrackingError, match=f"port {server.port}"):
        OpenIGTLinkServer("127.0.0.1", server.port)
    server.close()
