"""The skin node: rest mesh latched, vertices with normals, a marker for who asks."""

from dataclasses import replace

import numpy as np
from bench import pose_at
from geometry_msgs.msg import PoseStamped
from rclpy.parameter import Parameter
from sensor_msgs.msg import PointCloud2
from shape_msgs.msg import Mesh
from visualization_msgs.msg import Marker

from us_sim.geometry.pose import Pose
from us_sim.nodes.skin_deformer import SkinDeformer
from us_sim.recording.decoding import vectors_from
from us_sim.scene.building import build_membrane
from us_sim.scene.reading import load_scene


def test_vertices_normals_marker_and_latched_mesh(bench, small_scene):
    bench.make(SkinDeformer, scene=str(small_scene), lockstep=True, marker_opacity=0.75)
    clouds = bench.collect(PointCloud2, "skin/nodes")
    markers = bench.collect(Marker, "skin/marker")
    meshes = bench.collect(Mesh, "skin/mesh", latched=True)
    publisher = bench.publisher(PoseStamped, "probe/pose")
    bench.spin_until(lambda: meshes)
    for topic in ("skin/nodes", "skin/marker"):
        bench.spin_until(lambda topic=topic: bench.peer.count_publishers(topic) > 0)
    publisher.publish(pose_at(0.006, 5))
    bench.spin_until(lambda: clouds and markers)
    membrane = build_membrane(load_scene(small_scene))
    expected = membrane.deform(Pose([0.0, 0.0, 0.006], [0.0, 0.0, 0.0, 1.0]))
    assert clouds[0].header.stamp.sec == 5
    assert [field.name for field in clouds[0].fields] == [
        *("x", "y", "z"),
        *("normal_x", "normal_y", "normal_z"),
    ]
    table = np.frombuffer(clouds[0].data, np.float32).reshape(-1, 6)
    np.testing.assert_allclose(vectors_from(clouds[0]), expected.vertices, atol=1e-7)
    np.testing.assert_allclose(table[:, 3:], expected.normals, atol=1e-6)
    triangles = membrane.surface.triangles
    assert len(meshes[0].triangles) == len(triangles)
    assert list(meshes[0].triangles[3].vertex_indices) == triangles[3].tolist()
    points = np.array([[point.x, point.y, point.z] for point in markers[0].points])
    np.testing.assert_allclose(points, expected.vertices[triangles.ravel()], atol=1e-12)
    assert markers[0].type == Marker.TRIANGLE_LIST
    assert markers[0].color.a == 0.75
    assert (markers[0].header.stamp.sec, markers[0].header.frame_id) == (5, "patient")


def test_markers_are_sent_at_their_rate_and_again_when_stamps_go_back(bench, small_scene):
    bench.make(SkinDeformer, scene=str(small_scene), lockstep=True, marker_rate=0.5)
    clouds = bench.collect(PointCloud2, "skin/nodes")
    markers = bench.collect(Marker, "skin/marker")
    publisher = bench.publisher(PoseStamped, "probe/pose")
    for topic in ("skin/nodes", "skin/marker"):
        bench.spin_until(lambda topic=topic: bench.peer.count_publishers(topic) > 0)
    for second in (10, 11, 12, 13, 14, 1):
        publisher.publish(pose_at(0.0, second))
    bench.spin_until(lambda: len(clouds) == 6 and len(markers) >= 4)
    assert [marker.header.stamp.sec for marker in markers] == [10, 12, 14, 1]


def test_the_membrane_may_change_while_it_is_pressed(bench, small_scene):
    node = bench.make(SkinDeformer, scene=str(small_scene), lockstep=True)
    clouds = bench.collect(PointCloud2, "skin/nodes")
    publisher = bench.publisher(PoseStamped, "probe/pose")
    bench.spin_until(lambda: bench.peer.count_publishers("skin/nodes") > 0)
    publisher.publish(pose_at(0.006, 1))
    bench.spin_until(lambda: len(clouds) == 1)
    softer = {"membrane.anchor_stiffness": 1.0, "membrane.prestrain": 0.4}
    given = [Parameter(name, value=value) for name, value in softer.items()]
    assert node.set_parameters_atomically(given).successful
    publisher.publish(pose_at(0.006, 2))
    bench.spin_until(lambda: len(clouds) == 2)
    scene = load_scene(small_scene)
    settings = replace(scene.skin, anchor_stiffness=1.0, prestrain=0.4)
    expected = build_membrane(scene, settings).deform(Pose([0.0, 0.0, 0.006], [0.0, 0.0, 0.0, 1.0]))
    np.testing.assert_allclose(vectors_from(clouds[1]), expected.vertices, atol=1e-7)
    assert np.abs(vectors_from(clouds[1]) - vectors_from(clouds[0])).max() > 1e-4
