"""How the probe pushes nodes, and which nodes it holds."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.geometry.collider import Capsule, Convex, RoundedBox, Sphere
from us_sim.geometry.collider_distance import signed_distance
from us_sim.geometry.pose import Pose
from us_sim.geometry.triangles import part_size
from us_sim.tissue.contact.active_set import ActiveSet
from us_sim.tissue.contact.probe_gap import only_forward, push_out, wrench_on_probe
from us_sim.tissue.contact.surface_points import SurfacePoints
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import uniform_material
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
from us_sim.tissue.model import TissueModel, face_nodes
from us_sim.tissue.solvers.solver import create_solver

FINE, COARSE = 0.004, 0.02  # m, spacings that resolve a sphere of 30 mm, and that do not
SPHERE = Sphere(0.03)
BOX = RoundedBox(0.05, 0.015, 0.1, 0.003)
# A face of 55 mm radius; at the ends of its core, 30 mm aside, its normals are (0.6, 0, 0.8).
CONVEX = Convex(radius=0.055, length=0.07, width=0.02, height=0.06, rounding=0.005)
ROUNDER = Convex(radius=0.055, length=0.076, width=0.036, height=0.06, rounding=0.01)

lateral = st.floats(-0.06, 0.06)
depth = st.floats(-0.05, 0.02)


def gap_at(collider, where, spacing, pose=None):
    gap, normal = push_out(collider, pose or Pose(), np.array([where], dtype=float), spacing)
    return gap[0], normal[0]


def test_only_roundings_wider_than_two_spacings_are_resolved():
    assert not only_forward(SPHERE, FINE)
    assert only_forward(SPHERE, COARSE)
    assert only_forward(BOX, FINE)


@settings(deadline=None, max_examples=60)
@given(lateral, lateral, st.floats(-0.02, 0.02))
def test_outside_and_a_little_inside_the_gap_is_the_signed_distance(x, y, z):
    where = np.array([[x, y, z]])
    distance, normal = signed_distance(SPHERE, Pose(), where)
    if distance[0] < -0.015 or normal[0, 2] < 0:
        return
    gap, direction = gap_at(SPHERE, where[0], FINE)
    assert gap == pytest.approx(distance[0], abs=1e-12)
    np.testing.assert_allclose(direction, normal[0], atol=1e-9)


@settings(deadline=None, max_examples=80)
@given(
    st.sampled_from([SPHERE, Capsule(0.03, 0.04), BOX, CONVEX, ROUNDER]), lateral, lateral, depth
)
def test_what_is_pushed_is_pushed_out_and_never_back(collider, x, y, z):
    spacing = FINE
    gap, normal = gap_at(collider, (x, y, z), spacing)
    if not gap < 0:
        return
    assert normal[2] >= 0
    landed = np.array([[x, y, z]]) - gap * normal
    distance, _ = signed_distance(collider, Pose(), landed)
    assert distance[0] >= -1e-9


def test_deep_inside_the_push_is_towards_the_face():
    # 40 mm deep in a sphere of 30 mm: the nearest surface point would be behind.
    gap, normal = gap_at(SPHERE, (0.0, 0.0, -0.04), FINE)
    assert gap == pytest.approx(-0.04)
    np.testing.assert_allclose(normal, [0, 0, 1])
    # In the middle of a flat probe the nearest side is lateral.
    gap, normal = gap_at(BOX, (0.0, 0.004, -0.03), FINE)
    assert gap == pytest.approx(-0.03)
    np.testing.assert_allclose(normal, [0, 0, 1])


def test_a_jump_through_the_collider_still_finds_nodes_before_the_grip():
    assert gap_at(SPHERE, (0.0, 0.0, -0.07), FINE)[0] == pytest.approx(-0.07)
    assert gap_at(SPHERE, (0.0, 0.0, -0.07), COARSE)[0] == pytest.approx(-0.07)
    assert gap_at(SPHERE, (0.0, 0.0, -0.17), FINE)[0] > 0
    assert gap_at(SPHERE, (0.0, 0.0, -0.17), COARSE)[0] == np.inf


def test_an_unresolved_rounding_pushes_forward_onto_the_surface():
    gap, normal = gap_at(BOX, (0.0, 0.0065, -0.002), FINE)  # 2 mm out on the rounding of 3 mm
    np.testing.assert_allclose(normal, [0, 0, 1])
    landed = np.array([[0.0, 0.0065, -0.002 - gap]])
    assert signed_distance(BOX, Pose(), landed)[0][0] == pytest.approx(0.0, abs=1e-12)
    assert gap_at(BOX, (0.0, 0.0076, -0.01), FINE)[0] == np.inf


@pytest.mark.parametrize("spacing", [0.002, COARSE])  # the rounding is resolved, or not
def test_a_curved_face_pushes_square_to_itself(spacing):
    # On the face, 30 degrees aside: 1 mm within it, straight above, the push is along its radius.
    sine, cosine = 0.5, np.sqrt(0.75)
    on_face = 0.055 * np.array([sine, 0.0, cosine - 1.0])
    gap, normal = gap_at(ROUNDER, on_face, spacing)
    assert gap == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(normal, [sine, 0, cosine], atol=1e-12)
    # 30 mm straight above it the direction is the same, if the probe came down on the point.
    gap, normal = gap_at(ROUNDER, on_face - [0, 0, 0.03], spacing)
    assert gap == pytest.approx(-0.03 * cosine)
    np.testing.assert_allclose(normal, [sine, 0, cosine], atol=1e-12)


def test_beyond_the_ends_of_a_curved_face_an_unresolved_rounding_pushes_as_its_end_does():
    gap, normal = gap_at(CONVEX, (0.034, 0.0, -0.03), COARSE)  # 4 mm aside of the core
    np.testing.assert_allclose(normal, [0.6, 0, 0.8])
    # There the rounding of 5 mm rises 3 mm above the core's end, which is 15 mm back.
    assert gap == pytest.approx(0.8 * (-0.03 + 0.015 - 0.003))
    assert gap_at(CONVEX, (0.0351, 0.0, -0.03), COARSE)[0] == np.inf
    assert gap_at(CONVEX, (0.0, 0.0, -0.17), COARSE)[0] == np.inf
    assert gap_at(CONVEX, (0.0, 0.0, -0.14), COARSE)[0] == pytest.approx(-0.14)


def pressed_by_a_curved_face(method):
    """A solver, the pose of the face 9 mm deep in a block 50 mm high, and the deformation."""
    mesh = box_mesh(
        *(uniform_planes(-0.05, 0.05, 13) for _ in range(2)), uniform_planes(0, 0.05, 6)
    )
    fixed = mesh.nodes[:, 2] == 0.05
    material = uniform_material(mesh, Material(1e4, 0.45))
    model = TissueModel(mesh, material, fixed, CONVEX, face_nodes(mesh, "top"))
    solver = create_solver(method, model)
    for depth in (0.003, 0.006, 0.009, 0.009, 0.009):
        pressed = Pose(position=[0.0, 0.0, depth])
        deformation = solver.deform(pressed)
    touching = deformation.nodes[deformation.contact_nodes]
    assert np.ptp(touching[:, 0]) > 0.03
    assert np.ptp(touching[:, 2]) > 0.002  # it is bent
    assert abs(deformation.force[0]) < 1e-3 * -deformation.force[2]
    return model, pressed, deformation


def test_tissue_takes_the_shape_of_a_curved_face():
    model, pressed, deformation = pressed_by_a_curved_face("fem")
    touching = deformation.nodes[deformation.contact_nodes]
    np.testing.assert_allclose(signed_distance(CONVEX, pressed, touching)[0], 0.0, atol=1e-5)
    free = np.setdiff1d(np.arange(len(model.mesh.nodes)), deformation.contact_nodes)
    assert signed_distance(CONVEX, pressed, deformation.nodes[free])[0].min() > -1e-5


def test_a_curved_face_sinks_into_the_points_of_a_surface_on_springs():
    # Points of the flat triangles between the nodes lie on the face, on springs: it is in by up to
    # a tenth of the nodes' spacing, and a node of a touched triangle is out by no more than the arc
    # falls on the way to the next one: l^2 / (2 radius).
    model, pressed, deformation = pressed_by_a_curved_face("fem_nonlinear")
    spacing = model.contact_spacing
    displacement = (deformation.nodes - model.mesh.nodes).T
    points = SurfacePoints(model, part_size(CONVEX.rounding, spacing))
    distance, _ = signed_distance(CONVEX, pressed, points.rest + points.moved(displacement))
    assert -0.1 * spacing < distance.min() < 0.0
    touching = deformation.nodes[deformation.contact_nodes]
    off = signed_distance(CONVEX, pressed, touching)[0]
    assert -0.1 * spacing < off.min()
    assert off.max() < 0.1 * spacing + spacing**2 / (2 * CONVEX.radius)
    free = np.setdiff1d(np.arange(len(model.mesh.nodes)), deformation.contact_nodes)
    assert signed_distance(CONVEX, pressed, deformation.nodes[free])[0].min() > 0.0


@settings(deadline=None, max_examples=30)
@given(lateral, lateral, depth)
def test_pushes_move_with_the_probe(x, y, z):
    pose = Pose(np.array([0.1, -0.2, 0.3]), np.array([0.3, -0.2, 0.5, 0.8]))
    gap, normal = gap_at(SPHERE, (x, y, z), FINE)
    moved, direction = gap_at(SPHERE, pose.apply(np.array([[x, y, z]]))[0], FINE, pose)
    if gap > -0.014 and normal[2] > 1e-6:  # away from where the direction changes
        assert moved == pytest.approx(gap, abs=1e-9)
        np.testing.assert_allclose(direction, pose.rotation @ normal, atol=1e-6)


def test_wrench_is_the_reaction_about_the_probes_origin():
    # The probe's x is the patient's y; it pushes 2 N along the patient's z, 10 mm along its x.
    turned = Pose(np.array([0.5, 0.0, 0.0]), np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]))
    force, torque = wrench_on_probe(
        turned, np.array([[0.5, 0.01, 0.0]]), np.array([[0.0, 0.0, 2.0]])
    )
    np.testing.assert_allclose(force, [0, 0, -2], atol=1e-15)
    np.testing.assert_allclose(torque, [0, 0.02, 0], atol=1e-15)


REST = np.array([[0.0, 0, 0], [0.004, 0, 0], [0.1, 0, 0]])


def test_touched_nodes_lie_on_the_probe():
    contact, displacement = ActiveSet(SPHERE, REST, FINE), np.zeros((3, 3))
    pose = Pose(np.array([0.0, 0.0, 0.01]))
    assert contact.update(pose, displacement)
    np.testing.assert_array_equal(contact.touched, [True, True, False])
    distance, _ = signed_distance(SPHERE, pose, REST + displacement)
    np.testing.assert_allclose(distance[:2], 0, atol=1e-9)
    np.testing.assert_array_equal(displacement[2], 0)
    assert not contact.update(pose, displacement)
    assert contact.is_consistent(pose, displacement)


def test_a_node_that_would_be_pulled_is_let_go():
    contact, displacement = ActiveSet(SPHERE, REST, FINE), np.zeros((3, 3))
    pose = Pose(np.array([0.0, 0.0, 0.01]))
    contact.update(pose, displacement)
    contact.set_forces(np.array([[0.0, 0, 1], [0.0, 0, -1], [0.0, 0, 5]]))
    assert contact.normal_force[0] == pytest.approx(1)
    assert contact.normal_force[2] == 0
    assert not contact.is_consistent(pose, displacement)
    assert contact.update(pose, displacement)
    np.testing.assert_array_equal(contact.touched, [True, False, False])


def test_a_probe_that_is_taken_away_holds_nothing():
    pose = Pose(np.array([0.0, 0.0, 0.01]))
    for elsewhere in (None, Pose(np.array([0.0, 0.0, -0.05]))):
        contact, displacement = ActiveSet(SPHERE, REST, FINE), np.zeros((3, 3))
        contact.update(pose, displacement)
        assert contact.update(elsewhere, displacement)
        assert not contact.touched.any()
        assert not contact.update(elsewhere, displacement)


def test_adopted_nodes_are_those_on_the_surface():
    contact = ActiveSet(SPHERE, REST, FINE)
    contact.adopt(Pose(), np.zeros((3, 3)))
    np.testing.assert_array_equal(contact.touched, [True, False, False])
