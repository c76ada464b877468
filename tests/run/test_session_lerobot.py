"""Sessions as episodes of LeRobot: which moments, which image, which number; then real lerobot."""

import re

import cv2
import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation
from session_files import EPOCH, PERIOD, TYPES, image, pose, press, wrench

from us_sim.command.main import main
from us_sim.errors import BagError
from us_sim.recording.reader import read_bag
from us_sim.recording.schemas import serialize_stamped
from us_sim.recording.writer import BagWriter
from us_sim.run.session_lerobot import Episode, Track

JOINTS = "sensor_msgs/msg/JointState"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
SECOND = 10**9


def write(file, messages, types):
    with BagWriter(file) as writer:
        for topic, type_name in types.items():
            writer.add_topic(topic, type_name)
        for topic, data, log_time in messages:
            writer.write_message(topic, data, log_time)
    return file


@pytest.fixture
def session(tmp_path):
    messages = [(topic, data, log_time) for topic, data, log_time, *_ in press()]
    return write(tmp_path / "press.mcap", messages, TYPES)


def joints(stamp, **positions):
    return serialize_stamped(
        JOINTS,
        stamp,
        "base",
        name=list(positions),
        position=np.array(list(positions.values()), float),
        velocity=np.zeros(0),
        effort=np.zeros(0),
    )


def compressed(stamp, pixels):
    data = cv2.imencode(".png", pixels)[1].ravel()
    return serialize_stamped(COMPRESSED, stamp, "camera", format="png", data=data)


def frames_of(file, rate=None, **wanted):
    episode = Episode(read_bag(file), **wanted)
    moments = episode.choose_moments(rate or episode.usual_rate)
    frames = list(episode.make_frames(moments))
    return moments, frames, episode.names, list(episode.describe_use(moments))


def test_a_session_gives_what_it_was_made_of_at_a_third_of_its_rate(session):
    moments, frames, names, _ = frames_of(session, 20)
    assert np.diff(moments).tolist() == [SECOND // 20] * (len(moments) - 1)
    number = (moments - EPOCH) / PERIOD  # in poses since the first
    assert len(frames) == 40
    assert names["observation.state"][:2] == ["probe/wrench.fx", "probe/wrench.fy"]
    state = {name: k for k, name in enumerate(names["observation.state"])}
    depth = np.array([frame["observation.state"][state["probe/pose.z"]] for frame in frames])
    assert depth == pytest.approx(0.008 * np.sin(np.pi * number / 120), abs=1e-6)
    force = np.array([frame["observation.state"][state["probe/wrench.fz"]] for frame in frames])
    assert force == pytest.approx(-1e3 * depth, abs=1e-3)
    corner = [frame["observation.images.ultrasound_image"][0, 0] for frame in frames]
    assert corner == ((moments - EPOCH) // PERIOD).tolist()


def test_a_constant_turn_is_met_whatever_the_signs_of_quaternions():
    turn = Rotation.from_rotvec(np.outer(np.arange(40) / 10, [0.5, 1.0, -2.0])).as_quat()
    poses = np.hstack([np.zeros((20, 3)), turn[::2] * np.resize([-1, 1, 1], 20)[:, None]])
    table = pd.DataFrame(poses, index=EPOCH + 2 * PERIOD * np.arange(20))
    made = Track("/p", table, [], turns=True).interpolate(EPOCH + PERIOD * np.arange(39))[:, 3:]
    assert np.abs(np.einsum("ij,ij->i", made, turn[:39])) == pytest.approx(1.0, abs=1e-6)
    assert made[0, 3] >= 0
    assert (np.einsum("ij,ij->i", made[1:], made[:-1]) >= 0).all()


def test_the_rate_is_that_of_the_images_unless_it_is_said(session):
    assert Episode(read_bag(session)).usual_rate == 60
    assert len(frames_of(session)[0]) == len(frames_of(session, 60)[0]) == 120


def test_what_becomes_of_images_is_told(tmp_path):
    stamps = EPOCH + np.array([0, 1, 2, 6, 3, 7, 8]) * SECOND // 10  # one is late
    messages = [("/image", image(s, np.full((4, 5), k)), EPOCH + k) for k, s in enumerate(stamps)]
    file = write(tmp_path / "gap.mcap", messages, {"/image": TYPES["/ultrasound/image"]})
    _, frames, _, told = frames_of(file, 5)
    assert [f["observation.images.image"][0, 0] for f in frames] == [0, 2, 2, 3, 6]
    shown = "/image: 4 of 6 images shown, which are 0.200 s old"
    late = "1 message is stamped before one that was recorded earlier"
    assert told == ["5 frames", f"{shown} at most; {late}"]


def test_joints_of_several_publishers_and_compressed_images_go_together(tmp_path):
    red = np.zeros((6, 8, 3), np.uint8)
    red[..., 2] = 200  # OpenCV's order is blue, green, red
    messages = []
    for k in range(11):
        at = EPOCH + k * SECOND // 10
        arm = joints(at, elbow=0.1 * k, wrist=1.0 - 0.1 * k)
        messages += [("/joints", arm if k % 2 else joints(at, gripper=k), at)]
        messages += [("/camera", compressed(at, red), at)]
    file = write(tmp_path / "arm.mcap", messages, {"/joints": JOINTS, "/camera": COMPRESSED})
    moments, frames, names, _ = frames_of(file, 10, action="joints")
    assert names["action"] == ["joints.gripper", "joints.elbow", "joints.wrist"]
    assert (moments[0], moments[-1]) == (EPOCH + SECOND // 10, EPOCH + 9 * SECOND // 10)
    since = np.arange(1, 10)
    wanted = np.column_stack([since, 0.1 * since, 1.0 - 0.1 * since])
    assert np.array([frame["action"] for frame in frames]) == pytest.approx(wanted, abs=1e-6)
    assert frames[0]["observation.images.camera"][0, 0].tolist() == [200, 0, 0]
    assert "observation.state" not in frames[0]


@pytest.mark.parametrize(
    ("case", "by_log_time", "said"),
    [
        ("bag-time-back/stamps_back_by_20_s.mcap", False, "back by 30.0 s"),
        ("bag-time-back/stamps_back_by_20_s.mcap", True, "1200 messages, 0.117 s apart at most"),
        ("bag-quaternions/quaternions.mcap", False, "360 messages.*120 are not finite"),
        ("bag-stamps-zero/zed_like.mcap", False, "60 messages have no stamp"),
        ("bag-every-type/test_bag_mcap", False, "image is left out: the image holds 30 bytes"),
    ],
)
def test_nothing_is_dropped_invented_or_reordered_unsaid(shared_data, case, by_log_time, said):
    try:
        told = "\n".join(frames_of(shared_data / "cases" / case, by_log_time=by_log_time)[-1])
    except BagError as error:
        told = str(error)
    assert re.search(said, told)


def test_poses_of_one_stamp_are_counted(tmp_path):
    messages = [("/p", pose(EPOCH + k // 2 * PERIOD, z=1e-3 * k), EPOCH + k) for k in range(6)]
    file = write(tmp_path / "twice.mcap", messages, {"/p": TYPES["/probe/pose"]})
    _, frames, _, told = frames_of(file, 60)
    assert [frame["observation.state"][2] for frame in frames] == pytest.approx([0.0, 2e-3, 4e-3])
    assert "3 have the time of one before and are left out" in told[-1]


def test_clocks_that_differ_are_told_and_log_times_help(tmp_path):
    messages = []
    for k in range(5):
        messages.append(("/p", pose(k * PERIOD + 1, z=1e-3 * k), EPOCH + k * PERIOD))
        messages.append(("/f", wrench(EPOCH + k * PERIOD, k), EPOCH + k * PERIOD))
    types = {"/p": TYPES["/probe/pose"], "/f": TYPES["/probe/wrench"]}
    file = write(tmp_path / "clocks.mcap", messages, types)
    with pytest.raises(BagError, match=r"/p from 0\.000 to 0\.067 s.*give --by-log-time"):
        frames_of(file, 60)
    _, frames, _, _ = frames_of(file, 60, by_log_time=True)
    assert np.array([f["observation.state"][2] for f in frames]) == pytest.approx(
        1e3 * np.array([f["observation.state"][8] for f in frames]), abs=1e-3
    )


@pytest.mark.parametrize(
    ("wanted", "said"),
    [
        ({"topics": ["/nothing"]}, "has no topic /nothing; it has"),
        ({"topics": ["/tissue/nodes"]}, "a path needs one of geometry_msgs"),
        ({"action": "/ultrasound/image"}, "images, which are no action"),
    ],
)
def test_a_topic_of_no_use_is_refused(session, wanted, said):
    with pytest.raises(BagError, match=said):
        Episode(read_bag(session), **wanted)


def test_a_rate_that_is_none_is_refused(session, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("us_sim.run.session_lerobot.require_lerobot", lambda: None)
    command = ["bag", "to-lerobot", str(session), "--out", str(tmp_path / "data"), "--rate", "0"]
    assert main(command) == 1
    assert "--rate: 0 is outside 1 to 1000 frames a second" in capsys.readouterr().err


def test_a_bag_of_nothing_that_is_known_is_refused(tmp_path):
    file = write(tmp_path / "a.mcap", [("/p", pose(EPOCH), EPOCH)], {"/p": TYPES["/probe/pose"]})
    with pytest.raises(BagError, match="/p is left out: has 1 message of use, and two are needed"):
        Episode(read_bag(file))


def test_a_bag_by_the_real_rosbag2_gives_the_poses_that_it_holds(shared_data):
    bag = shared_data / "ros2-jazzy" / "bags"
    made = [frames_of(bag / f"probe_path_{kind}", 30) for kind in ("mcap", "sqlite3")]
    for moments, frames, names, told in made:
        assert len(frames) == len(moments) > 100
        assert frames[0]["observation.images.camera_image_raw"].shape[:2] == (48, 64)
        assert names["observation.state"][0] == "tracker/pose.x"
        turns = np.array([frame["observation.state"][3:] for frame in frames])
        assert np.linalg.norm(turns, axis=1) == pytest.approx(1.0, abs=1e-6)
        assert any("of 68 images shown" in sentence for sentence in told)


def test_lerobot_itself_loads_sessions(session, tmp_path, capsys):
    pytest.importorskip("lerobot", reason="lerobot is not installed: it brings torch")
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    out = tmp_path / "data"
    assert main(["bag", "to-lerobot", str(session), str(session), "--out", str(out)]) == 0
    assert f"240 frames at 60 Hz in {out}" in capsys.readouterr().out
    data = LeRobotDataset("a/b", root=out, delta_timestamps={"observation.state": [-1 / 60, 0.0]})
    assert (data.num_episodes, data.num_frames, data.fps) == (2, 240, 60)
    _, frames, names, _ = frames_of(session)
    assert data.features["observation.state"]["names"] == names["observation.state"]
    for k in (1, 57, 119):
        item = data[120 + k]
        now, before = (frames[k - late]["observation.state"] for late in (0, 1))
        assert item["observation.state"].numpy().tolist() == [before.tolist(), now.tolist()]
        shown = (255 * item["observation.images.ultrasound_image"].numpy()).round()
        assert (shown == frames[k]["observation.images.ultrasound_image"]).all()
    assert main(["bag", "to-lerobot", str(session), "--out", str(out)]) == 1
    assert "exists already: choose another folder" in capsys.readouterr().err
