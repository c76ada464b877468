"""The tissue node: mesh latched, nodes and wrench with the pose's stamp, solver switched live."""

import numpy as np
import pytest
from bench import pose_at
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.parameter import Parameter
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Int32MultiArray

from us_sim.assembly import tissue_model_of, volume_of
from us_sim.errors import SceneError
from us_sim.nodes.conversions import tetrahedra_from, vectors_from
from us_sim.nodes.tissue_deformer import TissueDeformer
from us_sim.pose import Pose
from us_sim.scene_file import load_scene
from us_sim.tissue.solver import create_solver


@pytest.fixture
def deformer(bench, small_scene):
    node = bench.make(TissueDeformer, scene=str(small_scene), lockstep=True)
    nodes = bench.collect(PointCloud2, "tissue/nodes")
    wrenches = bench.collect(WrenchStamped, "probe/wrench")
    publisher = bench.publisher(PoseStamped, "probe/pose")
    bench.spin_until(lambda: bench.peer.count_publishers("tissue/nodes") > 0)
    return node, nodes, wrenches, publisher


def press(bench, publisher, nodes, depth, second):
    count = len(nodes)
    publisher.publish(pose_at(depth, second))
    bench.spin_until(lambda: len(nodes) > count)
    return vectors_from(nodes[-1])


@pytest.mark.usefixtures("deformer")
def test_the_mesh_is_latched_for_who_comes_late(bench, small_scene):
    rest = bench.collect(PointCloud2, "tissue/rest", latched=True)
    tetrahedra = bench.collect(Int32MultiArray, "tissue/tetrahedra", latched=True)
    bench.spin_until(lambda: rest and tetrahedra)
    scene = load_scene(small_scene)
    mesh = tissue_model_of(scene, volume_of(scene)).mesh
    np.testing.assert_allclose(vectors_from(rest[0]), mesh.nodes, atol=1e-8)
    np.testing.assert_array_equal(tetrahedra_from(tetrahedra[0]), mesh.tetrahedra)


def test_nodes_are_the_solvers_and_carry_the_poses_stamp(bench, deformer, small_scene):
    _, nodes, wrenches, publisher = deformer
    received = press(bench, publisher, nodes, 0.004, 3)
    assert nodes[-1].header.stamp.sec == 3
    scene = load_scene(small_scene)
    solver = create_solver("fem", tissue_model_of(scene, volume_of(scene)))
    expected = solver.deform(Pose([0.0, 0.0, 0.004], [0.0, 0.0, 0.0, 1.0]))
    np.testing.assert_allclose(received, expected.nodes, atol=1e-7)
    bench.spin_until(lambda: wrenches)
    assert wrenches[-1].header.frame_id == "probe"
    assert wrenches[-1].wrench.force.z == pytest.approx(expected.force[2], rel=1e-6)
    assert wrenches[-1].wrench.force.z < 0  # the tissue pushes the probe out


def test_the_solver_is_switched_while_running_without_a_jump(bench, deformer):
    node, nodes, _, publisher = deformer
    for second in range(1, 12):
        before = press(bench, publisher, nodes, 0.004, second)
    assert node.set_parameters([Parameter("solver", value="msds")])[0].successful
    after = press(bench, publisher, nodes, 0.004, 20)
    assert node.health.state == "msds"
    assert np.abs(after - before).max() < 0.5 * 0.004
    refused = node.set_parameters([Parameter("solver", value="magic")])[0]
    assert not refused.successful
    assert "magic" in refused.reason
    press(bench, publisher, nodes, 0.004, 21)
    assert node.health.state == "msds"


def test_two_methods_run_side_by_side_and_diagnostics_say_how_far_they_are_apart(bench, deformer):
    node, nodes, _, publisher = deformer
    statuses = bench.collect(DiagnosticArray, "diagnostics")
    assert node.set_parameters([Parameter("compare_with", value="fem_cg")])[0].successful
    for second in range(1, 12):
        press(bench, publisher, nodes, 0.004, second)
    values = node.health.values
    assert values["compared_with"] == "fem_cg"
    assert 0 < float(values["difference_rms_mm"]) < float(values["difference_max_mm"]) < 4.0
    statuses.clear()
    bench.spin_until(
        lambda: any(v.key == "difference_max_mm" for s in statuses for v in s.status[0].values)
    )
    refused = node.set_parameters([Parameter("compare_with", value="fem")])[0]
    assert not refused.successful
    assert "itself" in refused.reason
    assert node.set_parameters([Parameter("compare_with", value="")])[0].successful
    press(bench, publisher, nodes, 0.004, 13)
    assert "compared_with" not in node.health.values


def test_nothing_is_solved_for_nobody(bench, small_scene):
    node = bench.make(TissueDeformer, scene=str(small_scene), lockstep=True)
    publisher = bench.publisher(PoseStamped, "probe/pose")
    publisher.publish(pose_at(0.004, 1))
    bench.spin_until(lambda: node.health.received == 1)
    assert node.health.state == "ready with fem"


def test_a_broken_pose_is_survived(bench, deformer):
    node, nodes, _, publisher = deformer
    publisher.publish(pose_at(float("nan"), 1))
    received = press(bench, publisher, nodes, 0.002, 2)
    assert np.isfinite(received).all()
    assert node.health.problems("pose") == 1


def test_a_scene_without_tissue_is_refused(bench, tmp_path):
    file = tmp_path / "bare.yaml"
    file.write_text(
        "name: bare\nvolume: {phantom: upper_arm, voxel_size: 1 mm}\n"
        "probe: {aperture: 40 mm, depth: 40 mm}\n"
    )
    with pytest.raises(SceneError, match="tissue: is missing"):
        bench.make(TissueDeformer, scene=str(file))
