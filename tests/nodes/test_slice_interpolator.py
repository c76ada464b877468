"""The slicing node: an image for every pose, from the deformed nodes with the same stamp."""

import numpy as np
import pytest
from bench import pose_at
from geometry_msgs.msg import PoseStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Image, PointCloud2
from std_msgs.msg import Int32MultiArray

from us_sim.assembly import probe_of, tissue_model_of, volume_of
from us_sim.nodes.conversions import (
    cloud_message,
    pixels_from,
    pose_from,
    tetrahedra_message,
)
from us_sim.nodes.slice_interpolator import SliceInterpolator
from us_sim.scene_file import load_scene
from us_sim.slicing.resampling import sample_plane
from us_sim.slicing.row_subdivision import RowSubdivision

BARE = """
name: bare
volume: {phantom: upper_arm, voxel_size: 1 mm}
probe: {aperture: 40 mm, depth: 40 mm, image: [60, 50]}
"""


def cloud(points, pose):
    return cloud_message(dict(zip("xyz", points.T, strict=True)), pose.header.stamp, "patient")


@pytest.fixture
def slicer(bench, small_scene):
    node = bench.make(SliceInterpolator, scene=str(small_scene), lockstep=True)
    scene = load_scene(small_scene)
    mesh = tissue_model_of(scene, volume_of(scene)).mesh
    images = bench.collect(Image, "ultrasound/image")
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    rest = bench.peer.create_publisher(PointCloud2, "tissue/rest", latched)
    tetrahedra = bench.peer.create_publisher(Int32MultiArray, "tissue/tetrahedra", latched)
    rest.publish(cloud(mesh.nodes, pose_at(0.0, 1)))
    tetrahedra.publish(tetrahedra_message(mesh.tetrahedra))
    poses = bench.publisher(PoseStamped, "probe/pose")
    nodes = bench.publisher(PointCloud2, "tissue/nodes")
    bench.spin_until(lambda: bench.peer.count_publishers("ultrasound/image") > 0)
    return node, mesh, images, poses, nodes


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
    cutter = RowSubdivision(
        volume_of(scene), mesh.nodes.astype(np.float32).astype(np.float64), mesh.tetrahedra
    )
    expected = cutter.image(moved, probe_of(scene).plane(pose_from(pose_at(0.003, 1))))
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
    assert node.health.problems("mesh") == 2


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
    plane = probe_of(scene).plane(pose_from(pose_at(0.002, 9)))
    np.testing.assert_array_equal(pixels_from(images[0]), sample_plane(volume_of(scene), plane))
    assert "tissue/nodes" not in dict(bench.peer.get_topic_names_and_types())
