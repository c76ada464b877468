"""Signed distances against analytic values and the laws that every distance obeys."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.collider import Capsule, RoundedBox, Sphere, signed_distance
from us_sim.errors import ProbeError
from us_sim.pose import Pose

SHAPES = [Sphere(0.03), Capsule(0.01, 0.04), RoundedBox(0.05, 0.015, 0.1, 0.003)]

coordinate = st.floats(-0.2, 0.2)
point = st.tuples(coordinate, coordinate, coordinate)
component = st.floats(-1.0, 1.0)
orientation = st.tuples(component, component, component, component).filter(
    lambda q: np.linalg.norm(q) > 0.1
)
shape = st.sampled_from(SHAPES)


def distance(collider, point, pose=None):
    found, normal = signed_distance(collider, pose or Pose(), np.array([point], dtype=float))
    return found[0], normal[0]


@pytest.mark.parametrize("collider", SHAPES)
def test_touches_the_plane_z_0_at_the_origin_and_lies_behind_it(collider):
    at_origin, normal = distance(collider, (0.0, 0.0, 0.0))
    assert at_origin == pytest.approx(0.0, abs=1e-15)
    np.testing.assert_allclose(normal, [0.0, 0.0, 1.0])
    assert distance(collider, (0.0, 0.0, -0.005))[0] == pytest.approx(-0.005)
    assert distance(collider, (0.0, 0.0, 0.02))[0] == pytest.approx(0.02)


def test_sphere_is_the_distance_to_its_centre_less_its_radius():
    points = np.random.default_rng(1).uniform(-0.1, 0.1, (50, 3))
    found, normal = signed_distance(Sphere(0.03), Pose(), points)
    away = points - [0.0, 0.0, -0.03]
    length = np.linalg.norm(away, axis=1)
    np.testing.assert_allclose(found, length - 0.03, atol=1e-15)
    np.testing.assert_allclose(normal, away / length[:, None], atol=1e-12)


@pytest.mark.parametrize(
    ("collider", "point", "expected", "normal"),
    [
        (Capsule(0.01, 0.04), (0.01, 0.02, -0.01), 0.01, (0, 1, 0)),  # beside the cylinder
        (Capsule(0.01, 0.04), (0.05, 0.0, -0.01), 0.02, (1, 0, 0)),  # beyond a cap
        (Capsule(0.01, 0.04), (0.023, 0.0, -0.006), -0.005, (0.6, 0, 0.8)),  # within a cap
        (RoundedBox(0.05, 0.015, 0.1, 0.003), (0.03, 0.0, -0.05), 0.005, (1, 0, 0)),
        (RoundedBox(0.05, 0.015, 0.1, 0.003), (0.0, 0.0, -0.105), 0.005, (0, 0, -1)),
        # An edge: 4 and 3 mm from the core's edge at x = 22 mm, z = -3 mm.
        (RoundedBox(0.05, 0.015, 0.1, 0.003), (0.026, 0.0, 0.0), 0.002, (0.8, 0, 0.6)),
        # Inside the core, 1 mm from its side y = 4.5 mm.
        (RoundedBox(0.05, 0.015, 0.1, 0.003), (0.0, 0.0035, -0.05), -0.004, (0, 1, 0)),
    ],
)
def test_analytic_points(collider, point, expected, normal):
    found, direction = distance(collider, point)
    assert found == pytest.approx(expected, abs=1e-15)
    np.testing.assert_allclose(direction, normal, atol=1e-12)


def test_on_the_core_the_normal_points_into_the_tissue():
    for collider, point in ((Sphere(0.03), (0, 0, -0.03)), (Capsule(0.01, 0.04), (0.01, 0, -0.01))):
        np.testing.assert_array_equal(distance(collider, point)[1], [0.0, 0.0, 1.0])


@settings(deadline=None, max_examples=60)
@given(shape, point)
def test_stepping_back_along_the_normal_lands_on_the_surface(collider, where):
    found, normal = distance(collider, where)
    assert np.linalg.norm(normal) == pytest.approx(1.0)
    surface, _ = distance(collider, np.array(where) - found * normal)
    assert surface == pytest.approx(0.0, abs=1e-12)


@settings(deadline=None, max_examples=60)
@given(shape, point, point)
def test_distance_grows_no_faster_than_one_metre_per_metre(collider, a, b):
    change = abs(distance(collider, a)[0] - distance(collider, b)[0])
    assert change <= np.linalg.norm(np.subtract(a, b)) + 1e-12


@settings(deadline=None, max_examples=40)
@given(shape, point)
def test_normal_is_the_gradient_away_from_the_core(collider, where):
    found, normal = distance(collider, where)
    if found < -0.5 * collider.offset_box[3]:
        return  # near the core nearest points change from one side to another
    step = 1e-7
    gradient = [
        (distance(collider, where + d)[0] - distance(collider, where - d)[0]) / (2 * step)
        for d in step * np.eye(3)
    ]
    np.testing.assert_allclose(gradient, normal, atol=1e-4)


@settings(deadline=None, max_examples=40)
@given(shape, point, point, orientation)
def test_moving_probe_and_points_together_changes_nothing(collider, where, position, quaternion):
    pose = Pose(np.array(position), np.array(quaternion))
    moved = pose.apply(np.array([where]))
    found, normal = signed_distance(collider, pose, moved)
    expected, direction = distance(collider, where)
    assert found[0] == pytest.approx(expected, abs=1e-12)
    if abs(expected) < collider.offset_box[3]:
        return  # within the core the last bit may decide between two nearest sides
    np.testing.assert_allclose(normal[0], pose.rotation @ direction, atol=1e-6)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Sphere(0.0), "Sphere.radius is 0.0"),
        (lambda: Sphere(float("nan")), "Sphere.radius is nan"),
        (lambda: Capsule(0.01, -1.0), "Capsule.length is -1.0"),
        (lambda: Capsule("wide", 1.0), "Capsule.radius is 'wide'"),
        (lambda: RoundedBox(0.05, 0.015, float("inf"), 0.003), "RoundedBox.height is inf"),
        (lambda: RoundedBox(0.05, 0.015, 0.1, 0.008), "at most 0.0075 m"),
    ],
)
def test_impossible_dimensions_are_refused(make, words):
    with pytest.raises(ProbeError, match=words):
        make()
