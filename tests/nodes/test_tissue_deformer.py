"""The tissue node: mesh latched, nodes and wrench with the pose's stamp, solver switched live."""

import time
from types import SimpleNamespace

import numpy as np
import pytest
from bench import pose_at
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.parameter import Parameter
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64MultiArray, Int32MultiArray
from visualization_msgs.msg import MarkerArray

from us_sim.errors import SceneError, SettingsError
from us_sim.geometry.pose import Pose
from us_sim.nodes import tissue_deformer
from us_sim.nodes.messages import contact_model_from
from us_sim.nodes.tissue_deformer import TissueDeformer
from us_sim.recording.decoding import tetrahedra_from, vectors_from
from us_sim.scene.building import build_structures, build_tissue_model, load_volume
from us_sim.scene.reading import load_scene
from us_sim.tissue.solvers.solver import create_solver


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
    mesh = build_tissue_model(scene, load_volume(scene)).mesh
    np.testing.assert_allclose(vectors_from(rest[0]), mesh.nodes, atol=1e-8)
    np.testing.assert_array_equal(tetrahedra_from(tetrahedra[0]), mesh.tetrahedra)


def test_after_a_frame_that_failed_the_tissue_begins_anew(bench, deformer, monkeypatch):
    node, nodes, _, publisher = deformer
    before = press(bench, publisher, nodes, 0.004, 1)
    solver = node._tissue.solver
    with monkeypatch.context() as broken:
        broken.setattr(solver, "deform", lambda _: 1 / 0)
        publisher.publish(pose_at(0.006, 2))
        bench.spin_until(lambda: node.failures)
    assert solver.is_settled
    np.testing.assert_allclose(press(bench, publisher, nodes, 0.004, 3), before, atol=1e-5)


def test_nodes_are_the_solvers_and_carry_the_poses_stamp(bench, deformer, small_scene):
    _, nodes, wrenches, publisher = deformer
    received = press(bench, publisher, nodes, 0.004, 3)
    assert nodes[-1].header.stamp.sec == 3
    scene = load_scene(small_scene)
    solver = create_solver("fem", build_tissue_model(scene, load_volume(scene)))
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


def test_a_force_out_of_balance_is_counted_and_not_sent_until_it_balances(bench, small_scene):
    file = small_scene.with_name("haptic.yaml")
    file.write_text(f"{small_scene.read_text()}tracker: {{source: haptic}}\n")
    starved = {"solver": "fem_nonlinear", "fem_nonlinear.most_iterations": 1}
    node = bench.make(TissueDeformer, scene=str(file), lockstep=True, **starved)
    nodes = bench.collect(PointCloud2, "tissue/nodes")
    wrenches = bench.collect(WrenchStamped, "probe/wrench")
    models = bench.collect(Float64MultiArray, "tissue/contact_model")
    publisher = bench.publisher(PoseStamped, "probe/pose")
    for topic in ("tissue/nodes", "tissue/contact_model"):
        bench.spin_until(lambda topic=topic: bench.peer.count_publishers(topic) > 0)
    press(bench, publisher, nodes, 0.012, 1)
    assert float(node.health.values["residual"]) > 0.1
    assert node.health.values["unbalanced"] == "1"
    assert "force" not in node.health.values
    assert node.health.warning
    relaxed = [Parameter("fem_nonlinear.most_iterations", value=440)]
    assert node.set_parameters(relaxed)[0].successful
    second = 2
    while not (wrenches and models):
        press(bench, publisher, nodes, 0.012, second)
        second += 1
    first = wrenches[0].header.stamp.sec
    assert first > 1
    assert float(node.health.values["force"]) > 0.1
    assert contact_model_from(models[0]).stamp == first * 10**9
    assert node.health.warning == ""


def test_nothing_is_solved_for_nobody(bench, small_scene):
    node = bench.make(TissueDeformer, scene=str(small_scene), lockstep=True)
    publisher = bench.publisher(PoseStamped, "probe/pose")
    publisher.publish(pose_at(0.004, 1))
    bench.spin_until(lambda: node.health.received == 1)
    assert node.health.state == "ready with fem"


@pytest.fixture
def scene_with_structures(small_scene, tmp_path):
    file = tmp_path / "structures.yaml"
    file.write_text(small_scene.read_text() + "structures: [vein, bone]\n")
    return file


def test_structures_are_where_the_tissue_has_carried_them(bench, scene_with_structures):
    node = bench.make(
        TissueDeformer,
        scene=str(scene_with_structures),
        lockstep=True,
        structure_triangles=5000,
        marker_rate=0.5,
    )
    markers = bench.collect(MarkerArray, "tissue/structures")
    nodes = bench.collect(PointCloud2, "tissue/nodes")
    publisher = bench.publisher(PoseStamped, "probe/pose")
    for topic in ("tissue/structures", "tissue/nodes"):
        bench.spin_until(lambda topic=topic: bench.peer.count_publishers(topic) > 0)
    for second in (1, 2, 3):
        press(bench, publisher, nodes, 0.006, second)
    bench.spin_until(lambda: len(markers) >= 2)
    assert [m.markers[0].header.stamp.sec for m in markers] == [1, 3]  # a marker every two seconds
    scene = load_scene(scene_with_structures)
    volume = load_volume(scene)
    mesh = build_tissue_model(scene, volume).mesh
    expected = list(build_structures(scene, volume, mesh, 5000))
    total = sum(len(made.surface.triangles) for made in expected)
    assert total == pytest.approx(5000, rel=0.1)
    assert node.health.values["structures"] == f"vein, bone: {total} triangles"
    for marker, made in zip(markers[-1].markers, expected, strict=True):
        assert (marker.ns, marker.header.frame_id, marker.type) == (made.name, "patient", 11)
        assert marker.color.b == np.float32(made.colour[2])
        points = np.array([[p.x, p.y, p.z] for p in marker.points]).reshape(-1, 3, 3)
        vertices, _ = made.surface.deform(vectors_from(nodes[-1]))
        np.testing.assert_allclose(points, vertices[made.surface.triangles], atol=2e-8)
    assert np.abs(vertices - made.surface.vertices).max() > 1e-5  # something moved


def test_structures_are_made_for_nobody_and_live_beside_the_deforming(bench, scene_with_structures):
    node = bench.make(TissueDeformer, scene=str(scene_with_structures), structure_triangles=2000)
    nodes = bench.collect(PointCloud2, "tissue/nodes")
    publisher = bench.publisher(PoseStamped, "probe/pose")
    bench.spin_until(lambda: bench.peer.count_publishers("tissue/nodes") > 0)
    press(bench, publisher, nodes, 0.004, 1)
    assert node.health.values["structures"] == "not made, nobody subscribes"
    markers = bench.collect(MarkerArray, "tissue/structures")
    bench.spin_until(lambda: bench.peer.count_publishers("tissue/structures") > 0)
    second = 2
    while not markers:
        press(bench, publisher, nodes, 0.004, second)
        second += 1
    assert [marker.ns for marker in markers[0].markers] == ["vein", "bone"]


def test_a_structure_that_cannot_be_made_is_said_and_the_tissue_goes_on(
    bench, tmp_path, small_scene
):
    (tmp_path / "far.obj").write_text("v 9 9 9\nv 9 9 8\nv 9 8 8\nf 1 2 3\n")
    file = tmp_path / "far.yaml"
    file.write_text(small_scene.read_text() + "structures: {clip: {file: far.obj}}\n")
    node = bench.make(TissueDeformer, scene=str(file), lockstep=True)
    nodes = bench.collect(PointCloud2, "tissue/nodes")
    markers = bench.collect(MarkerArray, "tissue/structures")
    publisher = bench.publisher(PoseStamped, "probe/pose")
    for topic in ("tissue/structures", "tissue/nodes"):
        bench.spin_until(lambda topic=topic: bench.peer.count_publishers(topic) > 0)
    press(bench, publisher, nodes, 0.004, 1)
    press(bench, publisher, nodes, 0.004, 2)
    assert node.health.problems["structures"] == 1
    assert (
        "structures.clip: 3 of the surface's 3 vertices lie outside"
        in node.health.values["structures"]
    )
    assert not markers


def test_a_structure_without_its_label_is_refused_at_once(bench, tmp_path, small_scene):
    file = tmp_path / "unknown.yaml"
    file.write_text(small_scene.read_text() + "structures: [kidney]\n")
    with pytest.raises(SceneError, match=r"structures\.kidney: .*`kidney`"):
        bench.make(TissueDeformer, scene=str(file))


def test_a_haptic_arm_gets_how_the_wrench_changes_and_nobody_else(bench, small_scene, tmp_path):
    bench.make(TissueDeformer, scene=str(small_scene), lockstep=True)
    assert bench.peer.count_publishers("tissue/contact_model") == 0
    file = tmp_path / "haptic.yaml"
    file.write_text(f"based_on: {small_scene}\ntracker: {{source: haptic}}")
    bench.make(TissueDeformer, scene=str(file), lockstep=True)
    models = bench.collect(Float64MultiArray, "tissue/contact_model")
    publisher = bench.publisher(PoseStamped, "probe/pose")
    bench.spin_until(lambda: bench.peer.count_publishers("tissue/contact_model") > 0)
    for step in range(3):
        publisher.publish(pose_at(0.003 + 1e-5 * step, 1 + step))
    bench.spin_until(lambda: len(models) == 3)
    first, second, third = (contact_model_from(message) for message in models)
    moved = np.concatenate([third.pose.position - first.pose.position, np.zeros(3)])
    change = third.wrench - first.wrench
    assert first.wrench[2] < 0  # the tissue pushes the probe out
    # Elasticity is linear, so on this way the model's force is exact.
    assert (-second.stiffness @ moved)[2] == pytest.approx(change[2], rel=1e-4)


def test_a_broken_pose_is_survived(bench, deformer):
    node, nodes, _, publisher = deformer
    publisher.publish(pose_at(float("nan"), 1))
    received = press(bench, publisher, nodes, 0.002, 2)
    assert np.isfinite(received).all()
    assert node.health.problems["pose"] == 1


@pytest.mark.parametrize(
    ("name", "value", "fact"),
    [
        ("solver", "wrong", "'wrong' .*fem, "),
        ("solver", "", "'' .*fem, "),
        ("compare_with", "wrong", "'wrong' .*fem, "),
        ("compare_with", "fem", "fem "),
    ],
)
def test_a_method_that_cannot_be_is_refused_before_the_volume_is_made(
    bench, small_scene, monkeypatch, name, value, fact
):
    monkeypatch.setattr(tissue_deformer, "load_volume", None)
    with pytest.raises(SettingsError, match=rf"^tissue_deformer\.{name}: {fact}"):
        bench.make(TissueDeformer, scene=str(small_scene), **{name: value})


def test_a_scene_without_tissue_is_refused(bench, tmp_path):
    file = tmp_path / "bare.yaml"
    file.write_text(
        "name: bare\nvolume: {phantom: upper_arm, voxel_size: 1 mm}\n"
        "probe: {aperture: 40 mm, depth: 40 mm}\n"
    )
    with pytest.raises(SceneError, match="tissue: "):
        bench.make(TissueDeformer, scene=str(file))


def test_a_late_frame_leaves_the_next_less_time_for_a_period_at_most(
    bench, small_scene, monkeypatch
):
    node = bench.make(TissueDeformer, scene=str(small_scene), solver="fem_nonlinear")
    nodes = bench.collect(PointCloud2, "tissue/nodes")
    bench.spin_until(lambda: bench.peer.count_publishers("tissue/nodes") > 0)
    press(bench, bench.publisher(PoseStamped, "probe/pose"), nodes, 0.002, 1)
    limits = []
    monkeypatch.setattr(node._tissue, "deform", lambda _, limit: limits.append(limit))
    monkeypatch.setattr(node, "_publish", lambda *_: None)
    clock = SimpleNamespace(monotonic=time.monotonic, monotonic_ns=lambda: 10**12)
    monkeypatch.setattr(tissue_deformer, "time", clock)
    for took in (0.0, 0.022, -1.0, 10.0, 0.0):  # s, that each frame takes
        node.arrived = 10**12 - round(1e9 * took)
        node._on_pose(pose_at(0.002, 2))
    usual, second, third, fourth, last = limits[-5:]
    assert third <= second + 1 / 60 - 0.022
    assert fourth >= max(usual, second, third)
    assert last == 0.002
