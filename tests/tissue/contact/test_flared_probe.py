"""The shape that presses: a convex body around the collider, and its distance function."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from us_sim.geometry.collider import Capsule, Convex, RoundedBox, Sphere
from us_sim.geometry.collider_distance import signed_distance
from us_sim.geometry.pose import Pose
from us_sim.tissue.contact.probe_gap import FlaredProbe

FINE, COARSE = 0.002, 0.012  # m, spacings that resolve the roundings below, and that do not
SPHERE = Sphere(0.022)
# The ends of the curved faces are 38.5 and 72 degrees steep.
COLLIDERS = [
    SPHERE,
    Capsule(0.02, 0.04),
    RoundedBox(0.05, 0.03, 0.06, 0.006),
    Convex(radius=0.055, length=0.076, width=0.036, height=0.06, rounding=0.01),
    Convex(radius=0.03, length=0.055, width=0.03, height=0.06, rounding=0.005),
]
TURNED = Pose(np.array([0.1, -0.2, 0.3]), np.array([0.3, -0.2, 0.5, 0.8]))
STEEPEST = math.tan(math.radians(60))

colliders = st.sampled_from(COLLIDERS)
spacings = st.sampled_from([FINE, COARSE])
lateral = st.floats(-0.06, 0.06)
places = st.tuples(lateral, lateral, st.floats(-0.08, 0.03)).map(lambda p: np.round(p, 8))
EXAMPLES = settings(deadline=None, max_examples=300)


def distance_at(probe, where, pose=None):
    gap, normal = probe.distance(pose or Pose(), np.array([where], dtype=float))
    return gap[0], normal[0]


@EXAMPLES
@given(colliders, spacings, places, places, st.floats(0.0, 1.0))
def test_the_distance_is_convex(collider, spacing, a, b, share):
    probe = FlaredProbe(collider, spacing)
    gap, _ = probe.distance(Pose(), np.array([a, b, (1 - share) * a + share * b]))
    assert gap[2] <= (1 - share) * gap[0] + share * gap[1] + 1e-12


@pytest.mark.parametrize("spacing", [FINE, COARSE])
@pytest.mark.parametrize("collider", COLLIDERS)
def test_the_distance_is_convex_deep_in_the_core_too(collider, spacing):
    # Where a curved front's arc is no longer near, its ends must not take its place.
    probe, rng = FlaredProbe(collider, spacing), np.random.default_rng(0)
    a = rng.uniform([-0.02, -0.002, -0.05], [0.02, 0.002, -0.01], (20000, 3))
    b = a + rng.normal(size=a.shape) * 0.003
    gaps = [probe.distance(Pose(), points)[0] for points in (a, b, 0.5 * (a + b))]
    assert (gaps[2] - 0.5 * (gaps[0] + gaps[1])).max() < 1e-12


@EXAMPLES
@given(colliders, spacings, places)
def test_the_normal_is_the_distances_gradient_and_its_length_is_one(collider, spacing, where):
    probe, step = FlaredProbe(collider, spacing), 1e-7
    _, normal = distance_at(probe, where)
    assert np.linalg.norm(normal) == pytest.approx(1.0)
    around = np.concatenate([where + step * np.eye(3), where - step * np.eye(3)])
    gap, normals = probe.distance(Pose(), around)
    assume(np.abs(normals - normal).max() < 1e-3)  # inside the core there are creases
    np.testing.assert_allclose((gap[:3] - gap[3:]) / (2 * step), normal, atol=1e-3)


@pytest.mark.parametrize(("spacing", "least"), [(FINE, 1.0), (COARSE, 0.875)])
@pytest.mark.parametrize("collider", COLLIDERS)
def test_only_where_two_leaning_flanks_meet_the_normal_jumps(collider, spacing, least):
    # There from (0, s, c) to (s c, s, c^2), of 60 degrees: by 29 degrees.
    probe, rng = FlaredProbe(collider, spacing), np.random.default_rng(0)
    where = rng.uniform([0.0, 0.0, -0.06], [0.06, 0.06, 0.01], (50000, 3))
    gap, normal = probe.distance(Pose(), where)
    _, close = probe.distance(Pose(), where + 1e-6 * rng.normal(size=where.shape))
    outside = gap > -0.99 * collider.offset_box[3]  # of its core
    assert (normal * close)[outside].sum(axis=1).min() > least - 1e-3


@EXAMPLES
@given(colliders, spacings, places)
def test_the_curvature_is_how_the_normal_turns(collider, spacing, where):
    probe, step = FlaredProbe(collider, spacing), 1e-7
    around = where + np.concatenate([s * np.eye(3) for s in (-2 * step, -step, step, 2 * step)])
    normals = probe.distance(Pose(), around)[1].reshape(4, 3, 3)
    turn = (normals[2] - normals[1]).T / (2 * step)
    wider = (normals[3] - normals[0]).T / (4 * step)
    assume(np.abs(turn - wider).max() < 1.0)  # it jumps where flat parts and bent ones meet
    jumps = np.abs(normals[3] + normals[0] - normals[2] - normals[1]).max() / step
    assume(jumps < 1.0 and np.linalg.norm(turn, 2) < 2.0 / collider.offset_box[3])  # its bound
    np.testing.assert_allclose(probe.curvature(Pose(), where[None])[0], turn, atol=1.0)


@pytest.mark.parametrize("spacing", [FINE, COARSE])
@pytest.mark.parametrize("height", [0.0, -0.001, 0.01])
def test_the_curvature_of_a_sphere_is_that_of_a_sphere_about_its_middle(spacing, height):
    # At the pole too, where its core, a point, is neither beside nor ahead.
    turn = FlaredProbe(SPHERE, spacing).curvature(Pose(), np.array([[0.0, 0.0, height]]))
    np.testing.assert_allclose(turn[0], np.diag([1.0, 1.0, 0.0]) / (0.022 + height), atol=1e-9)


@EXAMPLES
@given(colliders, spacings, places)
def test_before_the_front_it_is_the_distance_of_the_collider(collider, spacing, where):
    expected, direction = signed_distance(collider, Pose(), where[None])
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
    expected, direction = signed_distance(collider, Pose(), where[None])
    assume(expected[0] > -0.99 * box[3])
    gap, normal = distance_at(FlaredProbe(collider, FINE), where)
    assert gap == pytest.approx(expected[0], abs=1e-12)
    np.testing.assert_allclose(normal, direction[0], atol=1e-6)


@EXAMPLES
@given(colliders, spacings, places)
def test_it_contains_the_collider(collider, spacing, where):
    expected, _ = signed_distance(collider, Pose(), where[None])
    gap, _ = distance_at(FlaredProbe(collider, spacing), where)
    assert gap <= expected[0] + 1e-12


def test_leaning_flanks_end_a_part_of_the_spacing_beside_the_collider():
    box, flare = RoundedBox(0.05, 0.03, 0.06, 0.006), 0.6 * COARSE
    probe = FlaredProbe(box, COARSE)
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


@pytest.mark.parametrize("collider", COLLIDERS)
def test_behind_it_there_is_nothing(collider):
    box = collider.offset_box
    end = -box[3] - 2 * box[2] - 0.1  # the grip is 0.1 m long
    probe = FlaredProbe(collider, COARSE)
    assert distance_at(probe, (0.0, 0.0, end + 1e-6))[0] < 0.0
    assert distance_at(probe, (0.0, 0.0, end - 1e-6))[0] == np.inf
    assert not probe.curvature(Pose(), np.array([[0.0, 0.0, end - 1e-6]])).any()


def test_points_that_are_not_near_are_infinitely_far():
    gap, _ = FlaredProbe(SPHERE, COARSE).distance(Pose(), np.zeros((3, 3)), np.array([1]))
    np.testing.assert_array_equal(gap, [np.inf, 0.0, np.inf])


@EXAMPLES
@given(colliders, spacings, places)
def test_it_moves_with_the_probe(collider, spacing, where):
    probe = FlaredProbe(collider, spacing)
    gap, normal = distance_at(probe, where)
    turn = probe.curvature(Pose(), where[None])[0]
    there = TURNED.apply(where[None])
    near = where + 1e-9 * np.concatenate([np.eye(3), -np.eye(3)])
    # Rounding may put a point on the other side of a crease.
    assume(np.abs(probe.distance(Pose(), near)[1] - normal).max() < 1e-5)
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
    gap, found = probe.entered(last, pose, pose.apply(there[None]))
    found = pose.rotation.T @ found[0]
    off = 1e-6 / (cosine * collider.offset_box[3])  # angle, of a micrometre before the shape
    np.testing.assert_allclose(found, normal, atol=3 * off)
    assert gap[0] == pytest.approx(normal @ (there - on_way(root)), abs=0.15 * off + 1e-6)
    # The whole shape is behind the plane.
    along = np.linalg.svd(found[None])[2][1:]
    plane = there - gap[0] * found + 0.05 * (np.array([[1, 0], [-1, 0], [0, 1], [0, -1]]) @ along)
    assert probe.distance(Pose(), plane)[0].min() > -1e-9


def test_without_a_last_pose_points_came_from_before_the_front():
    probe = FlaredProbe(RoundedBox(0.05, 0.03, 0.06, 0.006), COARSE)
    gap, normal = probe.entered(None, TURNED, TURNED.apply(np.array([[0.018, 0.0, -0.05]])))
    assert gap[0] == pytest.approx(-0.05, abs=2e-6)
    np.testing.assert_allclose(normal[0], TURNED.rotation[:, 2], atol=1e-9)


def test_a_point_that_was_inside_is_pushed_out_where_it_was():
    probe = FlaredProbe(SPHERE, FINE)
    last = Pose(position=[0.0, 0.0, -0.02])
    gap, normal = probe.entered(last, Pose(), np.array([[0.0, 0.0, -0.021]]))
    assert gap[0] == pytest.approx(-0.021)
    np.testing.assert_allclose(normal[0], [0.0, 0.0, 1.0])
