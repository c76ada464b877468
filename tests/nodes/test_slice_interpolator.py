"""The slicing node: an image for every pose, from the deformed nodes with the same stamp."""

import dataclasses

import numpy as np
import pytest
from bench import pose_at
from geometry_msgs.msg import PoseStamped
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Image, PointCloud2
from std_msgs.msg import Float64MultiArray, Int32MultiArray

from us_sim.nodes.messages import cloud_message, tetrahedra_message
from us_sim.nodes.slice_interpolator import SliceInterpolator
from us_sim.recording.decoding import affine_from, pixels_from, pose_from
from us_sim.scene.building import build_probe, build_tissue_model, load_skin_surface, load_volume
from us_sim.scene.reading import load_scene
from us_sim.slicing.cutting.resampling import sample_plane
from us_sim.slicing.cutting.slicer import create_slicer

BARE = """
name: bare
volume: {phantom: upper_arm, voxel_size: 1 mm}
probe: {aperture: 40 mm, depth: 40 mm, image: [60, 50]}
"""


KEPT = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def cloud(points, pose):
    return cloud_message(dict(zip("xyz", points.T, strict=True)), pose.header.stamp, "patient")


@pytest.fixture
def slicer(bench, small_scene):
    node = bench.make(SliceInterpolator, scene=str(small_scene), lockstep=True)
    scene = load_scene(small_scene)
    mesh = build_tissue_model(scene, load_volume(scene)).mesh
    images = bench.collect(Image, "ultrasound/image")
    rest = bench.peer.create_publisher(PointCloud2, "tissue/rest", KEPT)
    tetrahedra = bench.peer.create_publisher(Int32MultiArray, "tissue/tetrahedra", KEPT)
    rest.publish(cloud(mesh.nodes, pose_at(0.0, 1)))
    tetrahedra.publish(tetrahedra_message(mesh.tetrahedra))
    poses = bench.publisher(PoseStamped, "probe/pose")
    nodes = bench.publisher(PointCloud2, "tissue/nodes")
    bench.spin_until(lambda: bench.peer.count_publishers("ultrasound/image") > 0)
    return node, mesh, images, poses, nodes


def test_the_face_meets_the_skin_where_the_scene_has_one(bench, small_scene):
    file = small_scene.with_name("touching.yaml")
    file.write_text(small_scene.read_text() + "imaging: {contact: true}\n")
    node = bench.make(SliceInterpolator, scene=str(file), lockstep=True)
    scene = load_scene(file)
    mesh, skin = (
        build_tissue_model(scene, load_volume(scene)).mesh,
        load_skin_surface(scene).vertices,
    )
    images = bench.collect(Image, "ultrasound/image")
    bench.peer.create_publisher(PointCloud2, "tissue/rest", KEPT).publish(
        cloud(mesh.nodes, pose_at(0.0, 1))
    )
    bench.peer.create_publisher(Int32MultiArray, "tissue/tetrahedra", KEPT).publish(
        tetrahedra_message(mesh.tetrahedra)
    )
    poses = bench.publisher(PoseStamped, "probe/pose")
    nodes = bench.publisher(PointCloud2, "tissue/nodes")
    skins = bench.publisher(PointCloud2, "skin/nodes")
    bench.spin_until(lambda: bench.peer.count_publishers("ultrasound/image") > 0)
    bench.spin_until(lambda: bench.peer.count_subscribers("skin/nodes") > 0)
    for number, lower in enumerate((0.0, 0.01), start=1):
        pose = pose_at(0.003, number)
        poses.publish(pose)
        nodes.publish(cloud(mesh.nodes, pose))
        bench.spin_until(lambda: node._unpaired is not None)
        assert len(images) == number - 1  # in lockstep the skin is waited for
        skins.publish(cloud(np.add(skin, [0.0, 0.0, lower]), pose))
        bench.spin_until(lambda number=number: len(images) == number)
    touching, in_air = (pixels_from(image)[40:] for image in images)
    assert touching.mean() > 20.0
    assert in_air.mean() < 0.2 * touching.mean()
    skins.publish(cloud(skin[1:], pose_at(0.003, 3)))
    bench.spin_until(lambda: node.health.problems["skin"] == 1)


def test_an_image_is_cut_at_the_pose_with_the_nodes_stamp(bench, slicer, small_scene):
    _, mesh, images, poses, nodes = slicer
    moved = (mesh.nodes + np.array([0.0, 0.0, 0.002])).astype(np.float32).astype(np.float64)
    poses.publish(pose_at(0.003, 1))
    poses.publish(pose_at(0.001, 2))
    nodes.publish(cloud(moved, pose_at(0.0, 1)))
    bench.spin_until(lambda: images)
    assert images[0].header.stamp.sec == 1
    assert images[0].header.frame_id == "probe"
    scene = load_scene(small_scene)
    rest = mesh.nodes.astype(np.float32).astype(np.float64)
    cutter = create_slicer("scan_conversion", load_volume(scene), rest, mesh.tetrahedra)
    expected = cutter.cut_image(moved, build_probe(scene).make_plane(pose_from(pose_at(0.003, 1))))
    np.testing.assert_array_equal(pixels_from(images[0]), expected)
    assert expected.std() > 5  # there is something in the picture


def test_nodes_that_come_before_their_pose_wait_for_it(bench, slicer):
    _, mesh, images, poses, nodes = slicer
    nodes.publish(cloud(mesh.nodes, pose_at(0.0, 4)))
    bench.spin_for(10)
    assert not images
    poses.publish(pose_at(0.0, 4))
    bench.spin_until(lambda: images)
    assert images[0].header.stamp.sec == 4


def test_nodes_that_are_not_finite_make_no_image_and_are_reported(bench, slicer):
    node, mesh, images, poses, nodes = slicer
    broken = mesh.nodes.copy()
    broken[3] = np.nan
    for second, points in ((1, broken), (2, mesh.nodes[:-1]), (3, mesh.nodes)):
        poses.publish(pose_at(0.0, second))
        nodes.publish(cloud(points, pose_at(0.0, second)))
    bench.spin_until(lambda: images)
    assert images[0].header.stamp.sec == 3
    assert node.health.problems["mesh"] == 2


def test_without_tissue_the_volume_is_cut_as_it_is(bench, tmp_path):
    file = tmp_path / "bare.yaml"
    file.write_text(BARE)
    bench.make(SliceInterpolator, scene=str(file), lockstep=True)
    images = bench.collect(Image, "ultrasound/image")
    poses = bench.publisher(PoseStamped, "probe/pose")
    bench.spin_until(lambda: bench.peer.count_publishers("ultrasound/image") > 0)
    poses.publish(pose_at(0.002, 9))
    bench.spin_until(lambda: images)
    scene = load_scene(file)
    plane = build_probe(scene).make_plane(pose_from(pose_at(0.002, 9)))
    np.testing.assert_array_equal(pixels_from(images[0]), sample_plane(load_volume(scene), plane))
    assert "tissue/nodes" not in dict(bench.peer.get_topic_names_and_types())


@pytest.fixture
def rigid(bench, tmp_path):
    file = tmp_path / "bare.yaml"
    file.write_text(BARE)
    node = bench.make(SliceInterpolator, scene=str(file), lockstep=True)
    images = bench.collect(Image, "ultrasound/image")
    poses = bench.publisher(PoseStamped, "probe/pose")
    bench.spin_until(lambda: bench.peer.count_publishers("ultrasound/image") > 0)
    return node, images, poses


def image_at(bench, images, poses, second):
    poses.publish(pose_at(0.002, second))
    bench.spin_until(lambda: images and images[-1].header.stamp.sec == second)
    return pixels_from(images[-1])


def test_the_console_is_changed_while_running(bench, rigid):
    node, images, poses = rigid
    before = image_at(bench, images, poses, 1).astype(int)
    results = node.set_parameters([Parameter("gain", value=6.0)])
    assert results[0].successful
    after = image_at(bench, images, poses, 2)
    # 6 dB of the 60 dB from black to white; what sends no echo stays black, next to which the
    # faintest echoes fade over 4 dB.
    expected = np.where(before > 0, np.minimum(before + 25.5, 255), 0)
    assert np.abs(after - expected)[(before == 0) | (before >= 17)].max() <= 1
    assert (after >= before).all()
    assert (after <= expected + 1).all()
    node.set_parameters([Parameter("gain", value=0.0)])
    np.testing.assert_array_equal(image_at(bench, images, poses, 3), before)


@pytest.mark.parametrize(
    ("name", "value", "fact"),
    [
        ("gain", float("nan"), "gain"),
        ("grey_map", "purple", "'purple'"),
        ("time_gain", [0.0, 200.0], "time_gain[1]: 200 dB"),
    ],
)
def test_a_setting_that_cannot_be_is_refused_and_nothing_changes(bench, rigid, name, value, fact):
    node, images, poses = rigid
    before = node.get_parameter(name).value
    image = image_at(bench, images, poses, 1)
    result = node.set_parameters([Parameter(name, value=value)])[0]
    assert not result.successful
    assert fact in result.reason
    assert node.get_parameter(name).value == before
    np.testing.assert_array_equal(image_at(bench, images, poses, 2), image)


def test_pixels_are_placed_in_millimetres_also_after_a_change_of_depth(bench, rigid):
    node, images, poses = rigid
    places = bench.collect(Float64MultiArray, "ultrasound/image_to_probe", latched=True)
    bench.spin_until(lambda: places)
    scene = load_scene(node.get_parameter("scene").value)
    last = [59, 49, 0, 1]  # column, row
    middle = affine_from(places[-1]) @ last
    np.testing.assert_allclose(middle[:3], [20e-3 - 40e-3 / 120, 0, 40e-3 - 40e-3 / 100])
    assert node.set_parameters([Parameter("depth", value=0.03)])[0].successful
    bench.spin_until(lambda: len(places) == 2)
    assert (affine_from(places[-1]) @ last)[2] == pytest.approx(30e-3 - 30e-3 / 100)
    shallow = dataclasses.replace(build_probe(scene), depth=0.03)
    plane = shallow.make_plane(pose_from(pose_at(0.002, 5)))
    expected = sample_plane(load_volume(scene), plane)
    np.testing.assert_array_equal(image_at(bench, images, poses, 5), expected)
