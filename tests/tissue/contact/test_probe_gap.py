"""How a probe pushes points: its gap, the nodes that it holds, the flared shape's distance."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from us_sim.geometry.collider import Capsule, Convex, RoundedBox, Sphere
from us_sim.geometry.collider_distance import measure_distances
from us_sim.geometry.pose import Pose
from us_sim.geometry.triangles import choose_part_size
from us_sim.tissue.contact.active_set import ActiveSet
from us_sim.tissue.contact.probe_gap import FlaredProbe, measure_gaps, wrench_on_probe
from us_sim.tissue.contact.surface_points import SurfacePoints
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import make_uniform_materials
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
    gap, normal = measure_gaps(collider, pose or Pose(), np.array([where], dtype=float), spacing)
    return gap[0], normal[0]


@settings(deadline=None, max_examples=60)
@given(lateral, lateral, st.floats(-0.02, 0.02))
def test_outside_and_a_little_inside_the_gap_is_the_signed_distance(x, y, z):
    where = np.array([[x, y, z]])
    distance, normal = measure_distances(SPHERE, Pose(), where)
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
    distance, _ = measure_distances(collider, Pose(), landed)
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
    assert measure_distances(BOX, Pose(), landed)[0][0] == pytest.approx(0.0, abs=1e-12)
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


def pressed_by_a_curved_face(method):
    """A solver, the pose of the face 9 mm deep in a block 50 mm high, and the deformation."""
    mesh = box_mesh(
        *(uniform_planes(-0.05, 0.05, 13) for _ in range(2)), uniform_planes(0, 0.05, 6)
    )
    fixed = mesh.nodes[:, 2] == 0.05
    material = make_uniform_materials(mesh, Material(1e4, 0.45))
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
    np.testing.assert_allclose(measure_distances(CONVEX, pressed, touching)[0], 0.0, atol=1e-5)
    free = np.setdiff1d(np.arange(len(model.mesh.nodes)), deformation.contact_nodes)
    assert measure_distances(CONVEX, pressed, deformation.nodes[free])[0].min() > -1e-5


@pytest.mark.slow
def test_a_curved_face_sinks_into_the_points_of_a_surface_on_springs():
    # Points of the flat triangles between the nodes lie on the face, on springs: it is in by up to
    # an eighth of the nodes' spacing, and a node of a touched triangle is out by no more than the
    # arc falls on the way to the next one: l^2 / (2 radius).
    model, pressed, deformation = pressed_by_a_curved_face("fem_nonlinear")
    spacing = model.contact_spacing
    displacement = (deformation.nodes - model.mesh.nodes).T
    points = SurfacePoints(model, choose_part_size(CONVEX.rounding, spacing))
    distance, _ = measure_distances(
        CONVEX, pressed, points.rest + points.interpolate_field(displacement)
    )
    assert -0.125 * spacing < distance.min() < 0.0
    touching = deformation.nodes[deformation.contact_nodes]
    off = measure_distances(CONVEX, pressed, touching)[0]
    assert -0.1 * spacing < off.min()
    assert off.max() < 0.1 * spacing + spacing**2 / (2 * CONVEX.radius)
    free = np.setdiff1d(np.arange(len(model.mesh.nodes)), deformation.contact_nodes)
    assert measure_distances(CONVEX, pressed, deformation.nodes[free])[0].min() > 0.0


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
    distance, _ = measure_distances(SPHERE, pose, REST + displacement)
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


# m, spacings that resolve the roundings below, and that do not
RESOLVING, WIDE = 0.002, 0.012
SMALL_SPHERE = Sphere(0.022)
# The ends of the curved faces are 38.5 and 72 degrees steep.
COLLIDERS = [
    SMALL_SPHERE,
    Capsule(0.02, 0.04),
    RoundedBox(0.05, 0.03, 0.06, 0.006),
    Convex(radius=0.055, length=0.076, width=0.036, height=0.06, rounding=0.01),
    Convex(radius=0.03, length=0.055, width=0.03, height=0.06, rounding=0.005),
]
TURNED = Pose(np.array([0.1, -0.2, 0.3]), np.array([0.3, -0.2, 0.5, 0.8]))
STEEPEST = math.tan(math.radians(60))

colliders = st.sampled_from(COLLIDERS)
spacings = st.sampled_from([RESOLVING, WIDE])
places = st.tuples(lateral, lateral, st.floats(-0.08, 0.03)).map(lambda p: np.round(p, 8))
EXAMPLES = settings(deadline=None, max_examples=80)


def distance_at(probe, where, pose=None):
    gap, normal = probe.measure_distances(pose or Pose(), np.array([where], dtype=float))
    return gap[0], normal[0]


@EXAMPLES
@given(colliders, spacings, places, places, st.floats(0.0, 1.0))
def test_the_distance_is_convex(collider, spacing, a, b, share):
    probe = FlaredProbe(collider, spacing)
    gap, _ = probe.measure_distances(Pose(), np.array([a, b, (1 - share) * a + share * b]))
    assert gap[2] <= (1 - share) * gap[0] + share * gap[1] + 1e-12


@pytest.mark.parametrize("spacing", [RESOLVING, WIDE])
@pytest.mark.parametrize("collider", COLLIDERS)
def test_the_distance_is_convex_deep_in_the_core_too(collider, spacing):
    # Where a curved front's arc is no longer near, its ends must not take its place.
    probe, rng = FlaredProbe(collider, spacing), np.random.default_rng(0)
    a = rng.uniform([-0.02, -0.002, -0.05], [0.02, 0.002, -0.01], (20000, 3))
    b = a + rng.normal(size=a.shape) * 0.003
    gaps = [probe.measure_distances(Pose(), points)[0] for points in (a, b, 0.5 * (a + b))]
    assert (gaps[2] - 0.5 * (gaps[0] + gaps[1])).max() < 1e-12


@EXAMPLES
@given(colliders, spacings, places)
def test_the_normal_is_the_distances_gradient_and_its_length_is_one(collider, spacing, where):
    probe, step = FlaredProbe(collider, spacing), 1e-7
    _, normal = distance_at(probe, where)
    assert np.linalg.norm(normal) == pytest.approx(1.0)
    around = np.concatenate([where + step * np.eye(3), where - step * np.eye(3)])
    gap, normals = probe.measure_distances(Pose(), around)
    assume(np.abs(normals - normal).max() < 1e-3)  # inside the core there are creases
    np.testing.assert_allclose((gap[:3] - gap[3:]) / (2 * step), normal, atol=1e-3)


@EXAMPLES
@given(colliders, spacings, places)
def test_the_curvature_is_how_the_normal_turns(collider, spacing, where):
    probe, step = FlaredProbe(collider, spacing), 1e-7
    around = where + np.concatenate([s * np.eye(3) for s in (-2 * step, -step, step, 2 * step)])
    normals = probe.measure_distances(Pose(), around)[1].reshape(4, 3, 3)
    turn = (normals[2] - normals[1]).T / (2 * step)
    wider = (normals[3] - normals[0]).T / (4 * step)
    assume(np.abs(turn - wider).max() < 1.0)  # it jumps where flat parts and bent ones meet
    jumps = np.abs(normals[3] + normals[0] - normals[2] - normals[1]).max() / step
    assume(jumps < 1.0 and np.linalg.norm(turn, 2) < 2.0 / collider.offset_box[3])  # its bound
    np.testing.assert_allclose(probe.curvature(Pose(), where[None])[0], turn, atol=1.0)


@EXAMPLES
@given(colliders, spacings, places)
def test_before_the_front_it_is_the_distance_of_the_collider(collider, spacing, where):
    expected, direction = measure_distances(collider, Pose(), where[None])
    x, y, z = direction[0]
    assume(expected[0] > -collider.offset_box[3])
    # The flanks begin where the rounding is 60 degrees steep.
    assume(z > 0.0 and abs(x) <= STEEPEST * z and abs(y) <= STEEPEST * math.hypot(x, z))
    gap, normal = distance_at(FlaredProbe(collider, spacing), where)
    assert gap == pytest.approx(expected[0], abs=1e-12)
    np.testing.assert_allclose(normal, direction[0], atol=1e-6)


@EXAMPLES
@given(colliders, places)
def test_a_rounding_that_the_nodes_resolve_keeps_its_own_flanks(collider, where):
    box = collider.offset_box
    where[2] = max(where[2], -box[3] - 2 * box[2])  # behind that it goes on
    expected, direction = measure_distances(collider, Pose(), where[None])
    assume(expected[0] > -0.99 * box[3])
    gap, normal = distance_at(FlaredProbe(collider, RESOLVING), where)
    assert gap == pytest.approx(expected[0], abs=1e-12)
    np.testing.assert_allclose(normal, direction[0], atol=1e-6)


def test_leaning_flanks_end_a_part_of_the_spacing_beside_the_collider():
    box, flare = RoundedBox(0.05, 0.03, 0.06, 0.006), 0.6 * WIDE
    probe = FlaredProbe(box, WIDE)
    for where, side in [((0.025, 0, -0.05), (1, 0, 0)), ((0, -0.015, -0.05), (0, -1, 0))]:
        gap, normal = distance_at(probe, where)
        assert gap == pytest.approx(-flare)
        np.testing.assert_array_equal(normal, side)
    # Half way along the lean: from the end of the core's front, 60 degrees to it.
    lean = np.array([math.sqrt(0.75), 0.0, 0.5])
    where = [0.019 + 0.5 * flare, 0.0, -0.006 - 0.5 * flare * STEEPEST]
    gap, normal = distance_at(probe, where + 0.007 * lean)
    assert gap == pytest.approx(0.001)
    np.testing.assert_allclose(normal, lean)


@EXAMPLES
@given(colliders, spacings, places)
def test_it_moves_with_the_probe(collider, spacing, where):
    probe = FlaredProbe(collider, spacing)
    gap, normal = distance_at(probe, where)
    turn = probe.curvature(Pose(), where[None])[0]
    there = TURNED.transform_points(where[None])
    near = where + 1e-9 * np.concatenate([np.eye(3), -np.eye(3)])
    # Rounding may put a point on the other side of a crease.
    assume(np.abs(probe.measure_distances(Pose(), near)[1] - normal).max() < 1e-5)
    assume(np.abs(probe.curvature(Pose(), near) - turn).max() < 1e-2)
    moved, direction = distance_at(probe, there[0], TURNED)
    assert moved == pytest.approx(gap, abs=1e-12)
    r = TURNED.rotation
    np.testing.assert_allclose(direction, r @ normal, atol=1e-6)
    np.testing.assert_allclose(probe.curvature(TURNED, there)[0], r @ turn @ r.T, atol=1e-2)


@EXAMPLES
@given(colliders, spacings, st.integers(0, 2**32 - 1), st.sampled_from([Pose(), TURNED]))
def test_points_enter_through_the_plane_that_touches_where_their_way_goes_in(
    collider, spacing, seed, pose
):
    probe, rng = FlaredProbe(collider, spacing), np.random.default_rng(seed)
    there = rng.uniform([-0.02, -0.015, -0.04], [0.02, 0.015, -0.002])
    direction = rng.normal(size=3)
    came = there + 0.15 * direction / np.linalg.norm(direction)
    assume(distance_at(probe, there)[0] < -1e-4)
    assume(0.0 < distance_at(probe, came)[0] < np.inf)

    def on_way(part):
        return came + part * (there - came)

    root = brentq(lambda part: distance_at(probe, on_way(part))[0], 0.0, 1.0, xtol=1e-14)
    _, normal = distance_at(probe, on_way(root))
    cosine = -normal @ (there - came) / 0.15
    assume(cosine > 0.1)  # or it only grazes the shape
    # A probe that moved by the opposite, past a point that stayed.
    last = Pose(pose.position - pose.rotation @ (came - there), pose.orientation)
    gap, found = probe.find_entry_planes(last, pose, pose.transform_points(there[None]))
    found = pose.rotation.T @ found[0]
    off = 1e-6 / (cosine * collider.offset_box[3])  # angle, of a micrometre before the shape
    np.testing.assert_allclose(found, normal, atol=5 * off)
    assert gap[0] == pytest.approx(normal @ (there - on_way(root)), abs=0.15 * off + 1e-6)
    # The whole shape is behind the plane.
    along = np.linalg.svd(found[None])[2][1:]
    plane = there - gap[0] * found + 0.05 * (np.array([[1, 0], [-1, 0], [0, 1], [0, -1]]) @ along)
    assert probe.measure_distances(Pose(), plane)[0].min() > -1e-9


def test_a_point_that_was_inside_is_pushed_out_where_it_was():
    probe = FlaredProbe(SMALL_SPHERE, RESOLVING)
    last = Pose(position=[0.0, 0.0, -0.02])
    gap, normal = probe.find_entry_planes(last, Pose(), np.array([[0.0, 0.0, -0.021]]))
    assert gap[0] == pytest.approx(-0.021)
    np.testing.assert_allclose(normal[0], [0.0, 0.0, 1.0])
