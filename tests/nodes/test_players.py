"""Paths and recordings played again: pace, stamps, lockstep, ends."""

import re
import subprocess
import sys

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from mcap.reader import make_reader
from mcap.writer import Writer
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from rclpy.time import Time
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image
from std_msgs.msg import Int32MultiArray, String
from std_srvs.srv import Trigger

from us_sim.errors import BagError
from us_sim.nodes.messages import image_message, stamp_message
from us_sim.nodes.path_player import PathPlayer
from us_sim.nodes.session_player import SessionPlayer
from us_sim.nodes.session_recorder import SessionRecorder
from us_sim.recording.path import ProbePath, write_path
from us_sim.recording.reader import read_bag
from us_sim.recording.writer import BagWriter

EPOCH = 1_700_000_000_000_000_000
STEP = 20_000_000


@pytest.fixture
def path(tmp_path):
    return written(tmp_path / "path.mcap", STEP)


def written(file, step):
    stamps = EPOCH + step * np.arange(10)
    positions = np.zeros((10, 3))
    positions[:, 2] = np.arange(10) * 1e-3
    orientations = np.tile([0.0, 0, 0, 1], (10, 1))
    write_path(file, ProbePath("/tracker/pose", "patient", stamps, positions, orientations))
    return file


def nanoseconds(message):
    return Time.from_msg(message.header.stamp).nanoseconds


def test_poses_are_played_in_order_at_their_pace_with_new_stamps(bench, path):
    poses = bench.collect(PoseStamped, "tracker/pose")
    player = bench.make(PathPlayer, path=str(path))
    assert player.realtime_priority  # as a device, whose poses come regularly
    bench.spin_until(player.finished.done)
    bench.spin_until(lambda: len(poses) == 10)
    assert [round(pose.pose.position.z * 1e3) for pose in poses] == list(range(10))
    stamps = np.array([nanoseconds(pose) for pose in poses])
    assert abs(stamps[-1] - player.get_clock().now().nanoseconds) < 10e9
    assert 0.5 * 9 * STEP < stamps[-1] - stamps[0] < 10 * 9 * STEP
    assert (np.diff(stamps) > 0).all()


def test_a_player_goes_on_where_a_path_that_began_earlier_would_be(bench, path, tmp_path):
    poses = bench.collect(PoseStamped, "tracker/pose")
    first = bench.make(PathPlayer, path=str(path))
    bench.spin_until(lambda: len(poses) == 10)
    now = first.get_clock().now().nanoseconds
    assert 0.0 < 1e-9 * now - float(first.health.values["begun"]) < 30.0
    assert first.health.values["played"] == "10"
    slow = written(tmp_path / "slow" / "slow.mcap", 100 * 10**9)
    begun = round(1e-9 * now - 540.0, 6)
    player = bench.make(PathPlayer, path=str(slow), begun=begun)
    bench.spin_until(lambda: player.health.values.get("played") == "6")
    assert float(player.health.values["begun"]) == pytest.approx(begun, abs=1e-5)


@pytest.mark.parametrize(("loop", "ends"), [(False, True), (True, False)])
def test_a_path_that_would_be_over_ends_unless_it_loops(bench, path, loop, ends):
    poses = bench.collect(PoseStamped, "tracker/pose")
    player = bench.make(PathPlayer, path=str(path), begun=1_700_000_000.0, loop=loop)
    bench.spin_until(lambda: player.finished.done() if ends else len(poses) > 12)
    assert player.finished.done() == ends
    if ends:
        bench.spin_until(lambda: poses)
        assert [round(pose.pose.position.z * 1e3) for pose in poses] == [9]


def test_in_lockstep_the_next_pose_waits_for_the_image(bench, path):
    poses = bench.collect(PoseStamped, "tracker/pose")
    player = bench.make(PathPlayer, path=str(path), lockstep=True)
    assert not player.realtime_priority
    images = bench.publisher(Image, "ultrasound/image")
    bench.spin_until(lambda: len(poses) == 1)
    bench.spin_for(10)
    assert len(poses) == 1
    pixels = np.zeros((2, 2), np.uint8)
    for count in range(1, 11):
        bench.spin_until(lambda count=count: len(poses) == count)
        images.publish(image_message(pixels, poses[-1].header.stamp, "probe"))
    bench.spin_until(player.finished.done)


def test_nothing_is_played_before_what_is_awaited_is_there(bench, path):
    poses = bench.collect(PoseStamped, "tracker/pose")
    bench.make(PathPlayer, path=str(path), await_topics=["ultrasound/image"])
    bench.spin_for(60)
    assert not poses
    bench.peer.create_publisher(Image, "ultrasound/image", 1)
    bench.spin_until(lambda: len(poses) == 10)


def test_what_is_waited_for_is_said_and_is_what_the_recorder_records(bench, path, tmp_path):
    poses = bench.collect(PoseStamped, "tracker/pose")
    images = bench.peer.create_publisher(Image, "ultrasound/image", 1)
    recorder = bench.make(
        SessionRecorder, file=str(tmp_path / "a.mcap"), topics=["/ultrasound/image"]
    )
    bench.spin_until(images.get_subscription_count)
    bench.make(PathPlayer, path=str(path), await_recorded=["ultrasound/image"])
    bench.spin_until(lambda: len(poses) == 10)
    assert not recorder.count_subscribers("/probe/pose")
    other = bench.make(PathPlayer, path=str(path), await_recorded=["probe/pose"])
    other._waiting_since = 0.0  # it waits for long
    bench.spin_until(lambda: "awaited" in other.health.values)
    assert "/probe/pose" in other.health.values["awaited"]
    assert {round(1e3 * pose.pose.position.z) for pose in poses[9:]} == {9}  # the first one holds


@pytest.mark.parametrize("player", [PathPlayer, SessionPlayer])
def test_an_installed_bag_is_played_by_its_name(bench, player):
    assert not bench.make(player, path="press_and_slide.mcap").finished.done()


def test_poses_that_cannot_be_told_apart_are_refused_in_lockstep(bench, tmp_path):
    file = tmp_path / "same.mcap"
    stamps = np.full(3, EPOCH)
    orientations = np.tile([0.0, 0, 0, 1], (3, 1))
    path = ProbePath("/tracker/pose", "patient", stamps, np.zeros((3, 3)), orientations)
    write_path(file, path)
    with pytest.raises(BagError, match="neither stamps nor log times rise"):
        bench.make(PathPlayer, path=str(file), lockstep=True)


def test_what_is_not_cdr_is_left_out_of_a_recording(bench, tmp_path):
    file = tmp_path / "mixed.mcap"
    with file.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="test")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
        for topic, encoding in (("/said", "cdr"), ("/other", "json")):
            channel = writer.register_channel(topic, encoding, schema)
            data = bytes(serialize_message(String(data="yes")))
            writer.add_message(channel, EPOCH, data, EPOCH)
        writer.finish()
    said = bench.collect(String, "/said")
    other = bench.collect(String, "/other")
    player = bench.make(SessionPlayer, path=str(file))
    bench.spin_until(lambda: player.finished.done() and said)
    bench.spin_for(10)
    assert [message.data for message in said] == ["yes"]
    assert not other
    assert player.health.warning == "/other (json is not CDR): left out"


def _bag_of(file, types, encoding="cdr"):
    """A file with a message on a topic of each of the types, which need not exist."""
    with file.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="test")
        for number, name in enumerate(types):
            schema = writer.register_schema(name, "ros2msg", b"string data\n")
            channel = writer.register_channel(f"/t{number}", encoding, schema)
            writer.add_message(channel, EPOCH, bytes(serialize_message(String(data="yes"))), EPOCH)
        writer.finish()
    return file


def test_everything_that_is_left_out_of_a_recording_is_said(bench, tmp_path):
    types = ["std_msgs/msg/String", "String", "no_such_msgs/msg/Thing", "os/msg/path"]
    file = _bag_of(tmp_path / "foreign.mcap", types)
    warning = bench.make(SessionPlayer, path=str(file)).health.warning
    assert [word for word in ("/t0", "/t1", "/t2", "/t3") if word in warning] == [
        "/t1",
        "/t2",
        "/t3",
    ]


@pytest.mark.parametrize("types", [["String"], []])
def test_a_recording_of_which_nothing_can_be_played_is_refused(bench, tmp_path, types):
    file = _bag_of(tmp_path / "foreign.mcap", types)
    with pytest.raises(BagError, match="holds nothing that can be played: "):
        bench.make(SessionPlayer, path=str(file))


@pytest.fixture
def damaged(tmp_path):
    file = tmp_path / "damaged.mcap"
    with BagWriter(file, chunk_size=500) as bag:
        bag.add_topic("/said", "std_msgs/msg/String")
        for k in range(100):
            bag.write_message("/said", bytes(serialize_message(String(data=f"{k:03}"))), EPOCH + k)
    with file.open("rb") as stream:
        chunk = make_reader(stream).get_summary().chunk_indexes[1]
    content = bytearray(file.read_bytes())
    content[chunk.chunk_start_offset + chunk.chunk_length - 20] ^= 1
    file.write_bytes(content)
    return file


def test_of_a_damaged_recording_the_rest_is_played_and_what_is_missing_is_said(bench, damaged):
    said = bench.collect(String, "/said")
    player = bench.make(SessionPlayer, path=str(damaged), rate=100.0)
    bench.spin_until(lambda: player.finished.done() and said and said[-1].data == "099")
    sentence = str(player.finished.exception())
    assert re.match("not all .*damaged.mcap .* chunk at byte", sentence)
    assert player.health.problems["damage"] == 1
    assert not player.failures


@pytest.mark.slow
def test_a_damaged_recording_ends_the_player_with_a_status(damaged):
    command = [sys.executable, "-m", "us_sim.nodes.session_player", "--ros-args"]
    ended = subprocess.run(
        [*command, "-p", f"path:={damaged}"], capture_output=True, text=True, check=False
    )
    assert ended.returncode == 1
    assert re.search("^us_sim: not all ", ended.stderr, re.MULTILINE)
    assert "Traceback" not in ended.stderr


def test_a_recording_is_published_as_it_was(bench, shared_data):
    folder = shared_data / "ros2-jazzy" / "bags" / "probe_path_mcap"
    poses = bench.collect(PoseStamped, "/tracker/pose")
    player = bench.make(SessionPlayer, path=str(folder), rate=20.0)
    latched = bench.collect(Int32MultiArray, "/tissue/tetrahedra", latched=True)
    bench.spin_until(player.finished.done)
    bag = read_bag(folder)
    expected = [bag.deserialize(m) for m in bag.read_messages(["/tracker/pose"])]
    bench.spin_until(lambda: len(poses) == len(expected) and latched)
    for received, recorded in zip(poses, expected, strict=True):
        assert received.pose.position.z == recorded.pose.position.z
        assert received.header.stamp.nanosec == recorded.header.stamp.nanosec


def set_live(player, **values):
    """Set parameters while it plays; the reason where that is refused."""
    parameters = [Parameter(name, value=value) for name, value in values.items()]
    return player.set_parameters_atomically(parameters).reason


def test_a_path_is_held_still_gone_along_and_played_at_another_pace(bench, path):
    poses = bench.collect(PoseStamped, "tracker/pose")
    player = bench.make(PathPlayer, path=str(path), paused=True, stay=True)
    bench.spin_until(lambda: len(poses) > 5)
    assert {round(pose.pose.position.z * 1e3) for pose in poses} == {0}
    assert set_live(player, time=0.1) == ""  # the sixth pose
    poses.clear()
    bench.spin_until(lambda: len(poses) > 5)
    assert {round(pose.pose.position.z * 1e3) for pose in poses[2:]} == {5}
    assert player.health.values["position"] == "0.100"
    assert player.health.values["duration"] == "0.180"
    assert set_live(player, rate=0.01, paused=False) == ""
    assert player.health.state == "playing"
    assert "out of range" in set_live(player, rate=0.0)
    assert set_live(player, rate=100.0) == ""
    bench.spin_until(lambda: player.health.state == "finished")
    assert not player.finished.done()
    bench.spin_until(lambda: poses and round(poses[-1].pose.position.z * 1e3) == 9)
    poses.clear()
    bench.spin_until(lambda: len(poses) > 2)  # the probe is held there
    assert {round(pose.pose.position.z * 1e3) for pose in poses} == {9}
    poses.clear()
    assert set_live(player, time=0.1, rate=10.0) == ""
    bench.spin_until(lambda: poses and round(poses[-1].pose.position.z * 1e3) == 9)
    assert round(poses[0].pose.position.z * 1e3) == 5


def test_a_recording_is_paused_gone_along_and_ends_when_it_may(bench, tmp_path):
    file = tmp_path / "said.mcap"
    with BagWriter(file) as bag:
        bag.add_topic("/said", "std_msgs/msg/String")
        bag.add_topic("/excluded", "std_msgs/msg/String")
        for k in range(10):
            data = bytes(serialize_message(String(data=str(k))))
            bag.write_message("/said", data, EPOCH + k * 10**9)
            bag.write_message("/excluded", data, EPOCH + k * 10**9)
    said = bench.collect(String, "/said")
    player = bench.make(
        SessionPlayer, path=str(file), paused=True, stay=True, exclude=["/excluded"]
    )
    bench.spin_until(lambda: player.health.state == "paused")
    assert set_live(player, time=5.0) == ""
    bench.spin_until(lambda: said)
    assert [message.data for message in said] == ["5"]  # a moment of it, though it is paused
    assert player.health.values["position"] == "5.000"
    assert set_live(player, paused=False, rate=100.0) == ""
    bench.spin_until(lambda: player.health.state == "finished")
    bench.spin_until(lambda: said[-1].data == "9")
    assert [message.data for message in said] == ["5", "6", "7", "8", "9"]
    assert not player.count_publishers("/excluded")
    assert not player.finished.done()


def ask(bench, player, name):
    client = bench.peer.create_client(Trigger, f"/{player.get_name()}/{name}")
    bench.spin_until(client.service_is_ready)
    answer = client.call_async(Trigger.Request())
    bench.spin_until(answer.done)
    assert answer.result().success == (not answer.result().message)
    return answer.result().message


def depths(poses):
    """How deep the probe is, mm: the number of the pose."""
    return [round(pose.pose.position.z * 1e3) for pose in poses]


@pytest.fixture
def said_bag(tmp_path):
    file = tmp_path / "said" / "said.mcap"
    with BagWriter(file) as bag:
        bag.add_topic("/said", "std_msgs/msg/String")
        for k in range(10):
            bag.write_message(
                "/said", bytes(serialize_message(String(data=str(k)))), EPOCH + k * STEP
            )
    return file


@pytest.fixture(params=[PathPlayer, SessionPlayer])
def numbers(request, bench, path, said_bag):
    if request.param is PathPlayer:
        poses = bench.collect(PoseStamped, "tracker/pose")
        return lambda **given: bench.make(PathPlayer, path=str(path), **given), lambda: depths(
            poses
        )
    said = bench.collect(String, "/said")
    return (
        lambda **given: bench.make(SessionPlayer, path=str(said_bag), **given),
        lambda: [int(text.data) for text in said],
    )


def test_what_was_stopped_goes_on_when_its_time_is_set(bench, numbers):
    make, sent = numbers
    player = make(stay=True, loop=True, rate=0.5)
    bench.spin_until(sent)
    assert not ask(bench, player, "stop")
    assert player.health.state == "finished"
    assert ask(bench, player, "stop") == "nothing is played"
    bench.spin_for(30)
    assert player.health.state == "finished"  # and does not loop
    stopped = len(sent())
    assert set_live(player, time=0.16) == ""
    bench.spin_until(lambda: 9 in sent()[stopped:])
    assert list(dict.fromkeys(n for n in sent()[stopped:] if n > 5))[:2] == [8, 9]


def test_a_player_that_is_stopped_ends(bench, numbers):
    make, sent = numbers
    player = make(rate=0.1)
    bench.spin_until(sent)
    assert not ask(bench, player, "stop")
    assert player.finished.done()
    assert player.finished.exception() is None


def test_the_clock_is_that_of_the_recording(bench, numbers):
    make, sent = numbers
    ticks = bench.collect(Clock, "/clock")
    player = make(clock=100.0, rate=0.5, time=0.02, stay=True)
    bench.spin_until(lambda: player.health.state == "finished")
    end = stamp_message(EPOCH + 9 * STEP)
    bench.spin_until(lambda: ticks and ticks[-1].clock == end)
    times = np.array([Time.from_msg(tick.clock).nanoseconds for tick in ticks]) - EPOCH
    assert len(times) > 10  # 160 ms at half the pace are 32 ticks of 10 ms where nothing is late
    assert STEP <= times[0] < 2 * STEP
    assert (np.diff(times) >= 0).all()
    bench.spin_until(lambda: sent()[-1:] == [9])


def test_between_the_poses_of_a_slow_path_the_last_is_repeated(bench, tmp_path):
    poses = bench.collect(PoseStamped, "tracker/pose")
    sparse = written(tmp_path / "sparse.mcap", 10 * STEP)
    bench.make(PathPlayer, path=str(sparse), rate=0.1)
    bench.spin_until(lambda: 1 in depths(poses))
    assert depths(poses)[-1] == 1
    assert depths(poses).count(0) >= 4  # in a second; the image freezes after half of one
    assert (np.diff([nanoseconds(pose) for pose in poses]) > 0).all()


def test_in_lockstep_the_clock_goes_with_the_poses(bench, path):
    poses = bench.collect(PoseStamped, "tracker/pose")
    ticks = bench.collect(Clock, "/clock")
    images = bench.peer.create_publisher(Image, "ultrasound/image", 10)
    player = bench.make(PathPlayer, path=str(path), lockstep=True, clock=40.0, time=0.14)
    for count in range(1, 4):
        bench.spin_until(lambda count=count: len(poses) == count)
        images.publish(image_message(np.zeros((2, 2), np.uint8), poses[-1].header.stamp, "probe"))

    def times():
        return {Time.from_msg(tick.clock).nanoseconds - EPOCH for tick in ticks}

    bench.spin_until(lambda: player.finished.done() and len(times()) >= 3)
    assert depths(poses) == [7, 8, 9]
    assert times() == {7 * STEP, 8 * STEP, 9 * STEP}
