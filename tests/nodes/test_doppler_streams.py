"""Blood on topics: made for those who subscribe, under the pose's stamp, as the parameters say."""

import math

import numpy as np
import pytest
import yaml
from bench import pose_at
from geometry_msgs.msg import PoseStamped
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Image, PointCloud2
from std_msgs.msg import Int32MultiArray

from us_sim.errors import ProbeError, SceneError
from us_sim.nodes.messages import cloud_message, tetrahedra_message
from us_sim.nodes.slice_interpolator import SliceInterpolator
from us_sim.recording.decoding import field_from, pose_from
from us_sim.scene.building import (
    build_blood,
    build_probe,
    build_scanner,
    build_tissue_model,
    load_volume,
)
from us_sim.scene.reading import load_scene
from us_sim.slicing.flow.doppler import ColourDoppler

KEPT = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
FLOWS = {
    "artery": {
        "flow": {
            "kind": "arterial",
            "direction": [0, 1, 0],
            "peak_velocity": 0.8,
            "mean_velocity": 0.1,
        }
    },
    "vein": {},
}
TOPICS = ("velocity", "velocity_estimate", "spectrum", "m_mode", "image_annotated")


@pytest.fixture
def scene(tmp_path, small_scene):
    file = tmp_path / "flows.yaml"
    file.write_text(yaml.safe_dump({"based_on": str(small_scene), "structures": FLOWS}))
    return file


@pytest.fixture
def arm(scene):
    made = load_scene(scene)
    return build_tissue_model(made, load_volume(made)).mesh


def cloud(points, pose):
    return cloud_message(dict(zip("xyz", points.T, strict=True)), pose.header.stamp, "patient")


def tilted(second, depth=0.0):
    """A pose whose beams lean along the artery."""
    pose = pose_at(depth, second)
    pose.pose.orientation.x = math.sin(math.radians(12))
    pose.pose.orientation.w = math.cos(math.radians(12))
    return pose


@pytest.fixture
def send(bench, scene, arm):
    def make(**parameters):
        node = bench.make(SliceInterpolator, scene=str(scene), lockstep=True, **parameters)
        bench.peer.create_publisher(PointCloud2, "tissue/rest", KEPT).publish(
            cloud(arm.nodes, pose_at(0.0, 1))
        )
        bench.peer.create_publisher(Int32MultiArray, "tissue/tetrahedra", KEPT).publish(
            tetrahedra_message(arm.tetrahedra)
        )
        poses = bench.publisher(PoseStamped, "probe/pose")
        nodes = bench.publisher(PointCloud2, "tissue/nodes")

        def pose(second, depth=0.0):
            poses.publish(tilted(second, depth))
            nodes.publish(cloud(arm.nodes, tilted(second)))

        return node, pose

    return make


def test_velocities_are_those_of_the_domain_at_the_poses_stamp(bench, scene, arm, send):
    node, pose = send()
    collected = {name: bench.collect(Image, f"ultrasound/{name}") for name in TOPICS}
    for name in TOPICS:
        bench.spin_until(lambda n=name: bench.peer.count_publishers(f"ultrasound/{n}") > 0)
    bench.spin_until(lambda: all(stream.is_wanted for stream in node._streams[-4:]))
    for second in (7, 8):
        pose(second)
    bench.spin_until(lambda: all(len(messages) == 2 for messages in collected.values()))
    made = load_scene(scene)
    volume = load_volume(made)
    scanner, blood, probe = (
        build_scanner(made, volume),
        build_blood(made, volume),
        build_probe(made),
    )
    rest = arm.nodes.astype(np.float32).astype(np.float64)
    scanner.attach_mesh(rest, arm.tetrahedra)
    doppler = ColourDoppler(probe, made.colour)
    for k, second in enumerate((7, 8)):
        frame = scanner.make_frame(pose_from(tilted(second)), rest, time=float(second))
        truth, estimate = (collected[name][k] for name in TOPICS[:2])
        assert (truth.encoding, truth.header.stamp.sec, truth.header.frame_id) == (
            "32FC1", second, "probe",
        )  # fmt: skip
        np.testing.assert_array_equal(
            field_from(truth), doppler.compute_true_velocity(blood, frame)
        )
        np.testing.assert_array_equal(field_from(estimate), doppler.estimate_velocity(blood, frame))
    assert np.nanmax(np.abs(field_from(collected["velocity"][0]))) > 0.03
    for name in ("spectrum", "m_mode"):
        last = collected[name][-1]
        assert (last.encoding, last.header.stamp.sec) == ("rgb8", 8)
        assert np.frombuffer(last.data, np.uint8).any()


@pytest.mark.parametrize(("kind", "steering"), [("colour", 0.2), ("spectrum", 0.2)])
def test_what_is_to_follow_a_vessel_finds_it_and_stays_on_it(bench, send, kind, steering):
    given = {f"{kind}.follow": True, f"{kind}.steering": steering, "overlay": "velocity"}
    node, pose = send(**given)
    pictures = bench.collect(Image, "ultrasound/image_annotated")
    bench.collect(Image, "ultrasound/spectrum")
    bench.spin_until(lambda: node._annotated.is_wanted and node._streams[-2].is_wanted)

    def place(second):
        count = len(pictures)
        pose(second)
        bench.spin_until(lambda: len(pictures) > count)
        return [node.get_parameter(f"{kind}.{name}").value for name in ("lateral", "depth")]

    found = place(3)
    assert abs(found[0] - getattr(node.scene, kind).lateral) > 0.01
    assert place(4) == pytest.approx(found, abs=0.02)
    assert node.health.values["no_spectrum" if kind == "spectrum" else "no_colour"] == ""


@pytest.mark.parametrize("kind", ["m_mode", "spectrum"])
def test_a_strip_goes_on_when_the_line_or_the_gate_is_moved(bench, send, kind):
    node, pose = send(**{"spectrum.gain": 30.0})  # so that noise lights the columns
    pictures = bench.collect(Image, f"ultrasound/{kind}")
    stream = next(each for each in node._streams if each.topic.endswith(kind))
    bench.spin_until(lambda: stream.is_wanted)

    def columns(second):
        count = len(pictures)
        pose(second)
        bench.spin_until(lambda: len(pictures) > count)
        picture = np.frombuffer(pictures[-1].data, np.uint8)
        picture = picture.reshape(pictures[-1].height, pictures[-1].width, 3)
        lit = picture[:200, :512].any(axis=2).sum(axis=0)
        return np.count_nonzero(lit > 20)  # a line at 0 cm/s is in all

    columns(3)
    before = columns(4)  # of a sweep of four seconds
    assert before > 100
    assert node.set_parameters([Parameter(f"{kind}.lateral", value=0.05)])[0].successful
    assert columns(5) > before + 100
    assert node.set_parameters([Parameter(f"{kind}.sweep", value=8.0)])[0].successful
    assert columns(6) < before  # begun anew, as columns stand for other moments


@pytest.mark.parametrize(
    ("parameter", "value", "reason"),
    [
        ("colour.nyquist_velocity", 0.012, "colour.wall_filter: 0.015 m/s is not below nyquist"),
        ("colour.depth", 0.09, "colour.depth: the middle of the box at 90 mm lies outside"),
        ("flow.artery.direction", [1.0, 0.0, 0.0], "flow.direction: [1.0, 0.0, 0.0] is across"),
        ("flow.artery.mean_velocity", 0.5, "is less than twice mean_velocity"),
    ],
)
def test_what_cannot_be_is_refused_and_the_node_goes_on(send, parameter, value, reason):
    node, _ = send()
    before = node.get_parameter(parameter).value
    result = node.set_parameters([Parameter(parameter, value=value)])[0]
    assert not result.successful
    assert reason in result.reason or "range" in result.reason
    assert node.get_parameter(parameter).value == before


def test_a_depth_that_leaves_the_gate_outside_is_refused(send):
    node, _ = send(**{"spectrum.depth": 0.035})
    result = node.set_parameters([Parameter("depth", value=0.03)])[0]
    assert not result.successful
    assert "spectrum.depth: the gate at 35 mm lies outside the image" in result.reason
    assert node.set_parameters([Parameter("spectrum.depth", value=0.02)])[0].successful
    assert node.set_parameters([Parameter("depth", value=0.03)])[0].successful


def test_a_gate_outside_at_the_start_and_a_flow_in_no_tube_end_the_node(bench, scene, tmp_path):
    with pytest.raises(ProbeError, match=r"spectrum.depth: the gate at 90 mm lies outside"):
        bench.make(SliceInterpolator, scene=str(scene), **{"spectrum.depth": 0.09})
    wrong = tmp_path / "wrong.yaml"
    flow = {"muscle": FLOWS["artery"]}
    wrong.write_text(yaml.safe_dump({"based_on": str(scene), "structures": flow}))
    with pytest.raises(SceneError, match=r"wrong.yaml: structures.muscle.flow: the structure is"):
        bench.make(SliceInterpolator, scene=str(wrong))


def test_flows_change_while_it_runs(bench, send):
    node, pose = send()
    velocities = bench.collect(Image, "ultrasound/velocity")
    bench.spin_until(lambda: any(s.is_wanted for s in node._streams))
    pose(20)
    bench.spin_until(lambda: len(velocities) == 1)
    changes = {"flow.artery.direction": [0.0, -1.0, 0.0]}
    assert all(
        r.successful
        for r in node.set_parameters([Parameter(n, value=v) for n, v in changes.items()])
    )
    pose(20)
    bench.spin_until(lambda: len(velocities) == 2)
    one, other = (field_from(each) for each in velocities)
    assert np.nansum(np.abs(one)) > 0
    np.testing.assert_allclose(one, -other, atol=1e-6)
