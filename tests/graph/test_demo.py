"""The demo on a small scene: what it leaves behind, read by programs that are not ours."""

import json
from importlib.util import find_spec

import cv2
import pytest
from rosbags.highlevel import AnyReader

from us_sim.command.main import main
from us_sim.recording.reader import read_bag
from us_sim.run.session_check import check_bag

TOPICS = {
    "/tracker/pose": "geometry_msgs/msg/PoseStamped",
    "/probe/pose": "geometry_msgs/msg/PoseStamped",
    "/probe/status": "diagnostic_msgs/msg/DiagnosticStatus",
    "/probe/marker": "visualization_msgs/msg/MarkerArray",
    "/tissue/nodes": "sensor_msgs/msg/PointCloud2",
    "/tissue/rest": "sensor_msgs/msg/PointCloud2",
    "/tissue/tetrahedra": "std_msgs/msg/Int32MultiArray",
    "/probe/wrench": "geometry_msgs/msg/WrenchStamped",
    "/skin/mesh": "shape_msgs/msg/Mesh",
    "/skin/nodes": "sensor_msgs/msg/PointCloud2",
    "/skin/marker": "visualization_msgs/msg/Marker",
    "/ultrasound/image": "sensor_msgs/msg/Image",
    "/ultrasound/image_to_probe": "std_msgs/msg/Float64MultiArray",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}
if find_spec("tf2_msgs"):
    TOPICS["/tf"] = "tf2_msgs/msg/TFMessage"
POSES = 90


@pytest.fixture(scope="module")
def summary(demo):
    return json.loads((demo / "summary.json").read_text())


@pytest.mark.smoke
def test_every_topic_of_the_graph_is_recorded_with_type_and_stamps(demo):
    with AnyReader([demo]) as reader:
        types = {connection.topic: connection.msgtype for connection in reader.connections}
        assert types == TOPICS
        stamps = []
        for connection, _, data in reader.messages():
            if connection.topic == "/tracker/pose":
                header = reader.deserialize(data, connection.msgtype).header
                assert header.frame_id == "patient"
                stamps.append((header.stamp.sec, header.stamp.nanosec))
    assert len(stamps) == POSES
    assert stamps == sorted(set(stamps))


def test_the_recording_is_whole(demo):
    """But for gaps and late images, which a busy machine may make."""
    found = check_bag(read_bag(demo / "session.mcap")).findings
    assert not [each for each in found if each.kind not in ("gap", "latency")]


def test_counts_latency_and_areas_are_in_the_summary(summary):
    assert summary["poses_in"] == POSES
    assert 0 < summary["images_out"] <= POSES
    assert summary["dropped"] == POSES - summary["images_out"]
    assert summary["images_per_second"] > 5
    for topic in ("/probe/pose", "/tissue/nodes", "/ultrasound/image", "end_to_end"):
        latency = summary["latency_ms"][topic]
        assert 0 < latency["p50"] <= latency["p99"]
    areas = summary["areas"]
    assert len(areas["time_s"]) == len(areas["vein_mm2"]) == len(areas["artery_mm2"])
    assert min(areas["vein_mm2"]) > 0


def test_the_contact_sheet_is_a_picture(demo):
    picture = cv2.imread(str(demo / "contact_sheet.png"))
    assert picture.shape[0] > 600
    assert picture.std() > 20


def test_a_second_demo_does_not_overwrite_the_first(demo, played_scene, capsys):
    assert main(["demo", str(played_scene), "--out", str(demo)]) == 1
    assert "exists already; choose another folder with --out" in capsys.readouterr().err
