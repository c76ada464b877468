"""Probe paths and wrenches of real bags and our own, and every reason to have none."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from session_files import EPOCH, HI
from wrench_files import WrenchRecord, write_wrenches

from us_sim.errors import BagError
from us_sim.recording.path import POSE_STAMPED, ProbePath, list_bodies, read_path, write_path
from us_sim.recording.press_and_slide import make_press_and_slide
from us_sim.recording.reader import read_bag
from us_sim.recording.schemas import load_jazzy_definitions
from us_sim.recording.writer import BagWriter
from us_sim.run.session_tables import read_wrenches


def path_of(positions, orientations=None, **fields):
    positions = np.asarray(positions, dtype=float)
    if orientations is None:
        orientations = np.tile([0.0, 0, 0, 1], (len(positions), 1))
    stamps = EPOCH + 10**7 * np.arange(len(positions))
    return ProbePath("/tracker/pose", "patient", stamps, positions, orientations, **fields)


@pytest.mark.parametrize("name", ["mcap", "sqlite3"])
def test_real_bags_hold_the_path_that_was_published(shared_data, name):
    path = read_path(shared_data / f"ros2-jazzy/bags/probe_path_{name}")
    assert (path.topic, path.frame_id) == ("/tracker/pose", "patient")
    assert (path.rejected, path.note) == (0, "")
    assert len(path) in (273, 275)
    x, y, z = path.positions.T
    # The recorder missed the first poses, so the first z says with which k the bag begins.
    k = round(z[0] * 60 * 2 / 0.02) + np.arange(len(path))
    t = np.minimum(k / 60, 4.0)
    np.testing.assert_allclose(z, np.minimum(0.01 * t, 0.02), atol=1e-12)
    np.testing.assert_allclose(x, np.clip(0.02 * (t - 2), 0, 0.04), atol=1e-12)
    np.testing.assert_array_equal(y, 0)
    angle = 2 * np.degrees(np.arctan2(path.orientations[:, 0], path.orientations[:, 3]))
    np.testing.assert_allclose(angle, 10 * np.sin(np.pi * k / 60 / 2), atol=1e-9)
    assert np.diff(path.stamps).mean() == pytest.approx(1e9 / 60, rel=0.01)
    assert path.duration == pytest.approx(len(path) / 60, abs=0.1)


finite = st.floats(-1e3, 1e3)
poses = st.integers(1, 20).flatmap(
    lambda count: st.tuples(
        arrays.arrays(np.int64, count, elements=st.integers(0, 2**31 * 10**9 - 1)),
        arrays.arrays(np.float64, (count, 3), elements=finite),
        arrays.arrays(np.float64, (count, 4), elements=st.floats(0.01, 1)),
    )
)


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(poses, st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9))
def test_round_trip_to_the_bit_with_stamps_that_go_back(tmp_path_factory, poses, frame_id):
    stamps, positions, orientations = poses
    log_times = EPOCH + np.arange(len(stamps))
    path = ProbePath("/a/pose", frame_id, stamps, positions, orientations, log_times)
    file = tmp_path_factory.mktemp("path") / "path.mcap"
    write_path(file, path)
    read = read_path(file)
    assert (read.topic, read.frame_id) == ("/a/pose", frame_id)
    for array in ("stamps", "positions", "orientations", "log_times"):
        np.testing.assert_array_equal(getattr(read, array), getattr(path, array))


def test_a_written_pose_is_what_rclpy_serializes(shared_data, tmp_path):
    path = ProbePath(
        "/tracker/pose",
        "patient",
        np.array([1732147200_123456789]),
        np.array([[0.012, -0.034, 0.056]]),
        np.array([[0.5, -0.5, 0.5, 0.5]]),
    )
    write_path(tmp_path / "path.mcap", path)
    (message,) = read_bag(tmp_path).read_messages()
    sample = (shared_data / "ros2-jazzy/messages.json").read_text().split('"cdr_hex": "')[1]
    assert message.data.hex() == sample.split('"')[0]


@pytest.mark.parametrize("bad", [np.nan, "no orientation"])
def test_poses_that_are_none_are_left_out_and_counted(tmp_path, bad):
    positions, orientations = np.zeros((10, 3)), np.tile([0.0, 0, 0, 1], (10, 1))
    if isinstance(bad, str):
        orientations[3:5] = 0
    else:
        positions[3:5, 1] = bad
    write_path(tmp_path / "path.mcap", path_of(positions, orientations))
    path = read_path(tmp_path)
    assert (len(path), path.rejected) == (8, 2)
    assert path.stamps.tolist() == [EPOCH + 10**7 * k for k in (0, 1, 2, 5, 6, 7, 8, 9)]
    assert path.note.startswith("2 of the 10 poses on /tracker/pose are not finite")
    assert path.note.endswith("the first being number 4")


def test_no_usable_pose_at_all(tmp_path):
    write_path(tmp_path / "path.mcap", path_of(np.full((3, 3), np.nan)))
    with pytest.raises(BagError, match="3 of the 3 poses"):
        read_path(tmp_path)


def test_which_topic(tmp_path):
    with BagWriter(tmp_path / "bag.mcap") as bag:
        bag.add_topic("/note", "std_msgs/msg/String")
        bag.write_message("/note", HI, EPOCH)
        bag.flush()
        with pytest.raises(BagError, match=r"PoseStamped.* /note \(std_msgs"):
            read_path(tmp_path / "bag.mcap")
        for topic in ("/haptic/pose", "/probe/pose"):
            bag.add_topic(topic, POSE_STAMPED)
    with pytest.raises(BagError, match="--pose, of /haptic/pose, /probe/pose"):
        read_path(tmp_path, option="--pose")
    with pytest.raises(BagError, match=r"/note as std_msgs/msg/String.*geometry_msgs"):
        read_path(tmp_path, "note")
    with pytest.raises(BagError, match=r"/moon/pose; .* /haptic/pose, /note"):
        read_path(tmp_path, "/moon/pose")
    with pytest.raises(BagError, match=r"/probe/pose; .*silent"):
        read_path(tmp_path, "probe/pose")


def message(type_name, **fields):
    """A message of rosbags."""
    return load_jazzy_definitions().types[type_name](**fields)


def vector(kind, x):
    return message(f"geometry_msgs/msg/{kind}", x=x, y=0.0, z=0.0)


def header(frame, k):
    stamp = message("builtin_interfaces/msg/Time", sec=EPOCH // 10**9, nanosec=k)
    return message("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def upright():
    return message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)


def pose_at(x):
    point = vector("Point", x)
    return message("geometry_msgs/msg/Pose", position=point, orientation=upright())


def transform(parent, child, x, k):
    moved = message(
        "geometry_msgs/msg/Transform", translation=vector("Vector3", x), rotation=upright()
    )
    fields = {"header": header(parent, k), "child_frame_id": child, "transform": moved}
    return message("geometry_msgs/msg/TransformStamped", **fields)


def of_type(kind, k):
    """A message whose body, `tip` or `1`, is at x = k in frame `base`."""
    x, head = float(k), {"header": header("base", k)}
    covariance = {"covariance": np.zeros(36)}
    known = message("geometry_msgs/msg/PoseWithCovariance", pose=pose_at(x), **covariance)
    still = message(
        "geometry_msgs/msg/Twist", linear=vector("Vector3", 0.0), angular=vector("Vector3", 0.0)
    )
    twist = message("geometry_msgs/msg/TwistWithCovariance", twist=still, **covariance)
    moved = transform("base", "tip", x, k)
    return {
        POSE_STAMPED: lambda: message(kind, **head, pose=pose_at(x)),
        TF: lambda: message(kind, transforms=[transform("map", "base", 9.0, k), moved]),
        "geometry_msgs/msg/TransformStamped": lambda: moved,
        "geometry_msgs/msg/PoseArray": lambda: message(
            kind, **head, poses=[pose_at(9), pose_at(x)]
        ),
        "geometry_msgs/msg/PoseWithCovarianceStamped": lambda: message(kind, **head, pose=known),
        "nav_msgs/msg/Odometry": lambda: message(
            kind, **head, child_frame_id="tip", pose=known, twist=twist
        ),
    }[kind]()


def record(file, topics):
    """A bag of messages by topic."""
    with BagWriter(file) as bag:
        for topic, messages in topics.items():
            kind = messages[0].__msgtype__
            bag.add_topic(topic, kind)
            for k, each in enumerate(messages):
                bag.write_message(
                    topic, load_jazzy_definitions().serialize_cdr(each, kind), EPOCH + k
                )


TF = "tf2_msgs/msg/TFMessage"


@pytest.mark.parametrize(
    ("kind", "body"),
    [
        ("geometry_msgs/msg/TransformStamped", ""),
        ("geometry_msgs/msg/PoseWithCovarianceStamped", ""),
        ("nav_msgs/msg/Odometry", ""),
        ("geometry_msgs/msg/PoseArray", ":1"),
        (TF, ":tip"),
    ],
)
def test_every_kind_of_pose_message_is_a_path(tmp_path, kind, body):
    file = tmp_path / "bag.mcap"
    record(file, {"/poses": [of_type(kind, k) for k in range(4)]})
    path = read_path(file, f"poses{body}" if body else None)
    assert (path.topic, path.frame_id) == (f"/poses{body}", "base")
    np.testing.assert_array_equal(path.positions, [[k, 0, 0] for k in range(4)])
    np.testing.assert_array_equal(path.stamps - EPOCH // 10**9 * 10**9, range(4))
    if body:
        with pytest.raises(BagError, match=f"--topic, of /poses:.*, /poses{body}"):
            read_path(file, option="--topic")
        with pytest.raises(BagError, match=f"/poses:moon; .*/poses{body}"):
            read_path(file, "poses:moon")


def test_a_frame_of_tf_is_followed_up_to_another(tmp_path):
    file = tmp_path / "bag.mcap"
    mount = message(TF, transforms=[transform("tip", "probe", 0.5, 0)])
    record(file, {"/tf_static": [mount], "/tf": [of_type(TF, k) for k in range(3)]})
    path = read_path(file, "/tf:probe:base")
    assert path.frame_id == "base"
    np.testing.assert_array_equal(path.positions[:, 0], [0.5, 1.5, 2.5])
    assert read_path(file, "/tf:tip:map").positions[-1, 0] == 11.0
    with pytest.raises(BagError, match=r"/tf from 'base' .*'tip'"):
        read_path(file, "/tf:base:tip")


def of_tf(child, parent, x, seconds):
    made = transform(parent, child, x, 0)
    made.header.stamp.sec = round(seconds * 1e9) // 10**9
    made.header.stamp.nanosec = round(seconds * 1e9) % 10**9
    return message(TF, transforms=[made])


def test_the_links_of_a_chain_are_taken_at_one_time(tmp_path):
    """`map` to `odom` is stamped a second ahead, as by Nav2, and moves back as `odom` moves on."""
    times = 100 + 0.02 * np.arange(300)
    messages = [(t, of_tf("tip", "odom", t - 100, t)) for t in times]
    messages += [(t, of_tf("odom", "map", 99 - t, t + 1.0)) for t in times[::5]]
    file = tmp_path / "bag.mcap"
    record(file, {"/tf": [each for _, each in sorted(messages, key=lambda pair: pair[0])]})
    path = read_path(file, "/tf:tip:map")
    np.testing.assert_allclose(path.positions[:, 0], 0.0, atol=1e-9)
    assert path.stamps[[0, -1]].tolist() == [101 * 10**9, 105_980_000_000]


def test_tf_of_a_real_recorder_holds_the_path_of_its_poses(shared_data):
    bag = shared_data / "ros2-jazzy/bags/probe_path_mcap"
    (body,) = list_bodies(read_bag(bag))[TF]
    moved, posed = read_path(bag, body), read_path(bag)
    among = np.isin(moved.stamps, posed.stamps)
    assert among.sum() > 250
    of_both = posed.positions[np.isin(posed.stamps, moved.stamps)]
    np.testing.assert_allclose(moved.positions[among], of_both, atol=1e-12)


def wrenches(frame="probe", topic="/probe/wrench"):
    random = np.random.default_rng(0)
    stamps = 10**18 + np.arange(20) * 16_666_667
    return WrenchRecord(topic, frame, stamps, random.normal(size=(20, 6)))


def test_another_type_a_silent_topic_and_a_missing_one_are_refused(tmp_path):
    path = make_press_and_slide(rate=5.0)
    write_path(tmp_path / "path.mcap", path)
    with pytest.raises(BagError, match=POSE_STAMPED):
        read_wrenches(read_bag(tmp_path / "path.mcap"), path.topic)
    with pytest.raises(BagError, match="topic probe/wrench"):
        read_wrenches(read_bag(tmp_path / "path.mcap"), "probe/wrench")
    none = WrenchRecord("/probe/wrench", "probe", np.zeros(0, np.int64), np.zeros((0, 6)))
    (tmp_path / "silent").mkdir()
    write_wrenches(tmp_path / "silent" / "silent.mcap", none)
    with pytest.raises(BagError, match="no wrench"):
        read_wrenches(read_bag(tmp_path / "silent" / "silent.mcap"), "probe/wrench")


def test_a_topic_of_two_frames_is_refused_and_the_trackers_poses_come_before_the_probes(tmp_path):
    seen = message(POSE_STAMPED, header=header("ndi", 0), pose=pose_at(1.0))
    own = message(POSE_STAMPED, header=header("patient", 1), pose=pose_at(2.0))
    record(tmp_path / "a.mcap", {"/probe/pose": [own], "/tracker/pose": [own, own]})
    assert read_path(tmp_path / "a.mcap").topic == "/tracker/pose"
    (tmp_path / "b").mkdir()
    # Where a hand and a device took turns, the probe's own are the path.
    record(tmp_path / "b/b.mcap", {"/tracker/pose": [seen, own], "/probe/pose": [own]})
    assert read_path(tmp_path / "b/b.mcap").topic == "/probe/pose"
    with pytest.raises(BagError, match="ndi, patient"):
        read_path(tmp_path / "b/b.mcap", "tracker/pose")


def test_wrenches_are_read_by_their_topics_each_of_one_frame(tmp_path):
    made = wrenches()
    with BagWriter(tmp_path / "w.mcap") as writer:
        write_wrenches(writer, made)
        for frame, topic in (("flange", "/arm/wrench"), ("probe", "/two"), ("flange", "/two")):
            write_wrenches(writer, wrenches(frame, topic))
    bag = read_bag(tmp_path / "w.mcap")
    frame, read = read_wrenches(bag, "probe/wrench")
    assert (frame, len(read)) == ("probe", 20)
    assert np.array_equal(read["stamp"], made.stamps)
    assert np.array_equal(read.to_numpy()[:, :6], made.wrenches)
    assert read_wrenches(bag, "arm/wrench")[0] == "flange"
    with pytest.raises(BagError, match="probe, flange"):
        read_wrenches(bag, "two")


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("missing.mcap", None, "missing.mcap"),
        ("a.xml", "#", "PLUS"),
    ],
)
def test_files_that_are_no_path(tmp_path, name, content, words):
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(BagError, match=re.escape(words)):
        read_path(tmp_path / name)
