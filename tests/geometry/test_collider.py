"""Signed distances against analytic values and the laws that every distance obeys."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from us_sim.errors import ProbeError
from us_sim.geometry.collider import Capsule, Convex, RoundedBox, Sphere
from us_sim.geometry.collider_distance import measure_distances
from us_sim.geometry.pose import Pose

# A core of 50 mm radius, whose front reaches 30 mm to each side: its ends are 40 mm above the
# centre of curvature, so that normals there are (0.6, 0, 0.8).
BENT = Convex(radius=0.055, length=0.07, width=0.02, height=0.06, rounding=0.005)
# Nearly a half cylinder, with next to no sides.
MICRO = Convex(radius=0.014, length=0.027, width=0.014, height=0.016, rounding=0.002)

SHAPES = [Sphere(0.03), Capsule(0.01, 0.04), RoundedBox(0.05, 0.015, 0.1, 0.003), BENT, MICRO]

coordinate = st.floats(-0.2, 0.2)
point = st.tuples(coordinate, coordinate, coordinate)
component = st.floats(-1.0, 1.0)
orientation = st.tuples(component, component, component, component).filter(
    lambda q: np.linalg.norm(q) > 0.1
)
shape = st.sampled_from(SHAPES)


def distance(collider, point, pose=None):
    found, normal = measure_distances(collider, pose or Pose(), np.array([point], dtype=float))
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
    found, normal = measure_distances(Sphere(0.03), Pose(), points)
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
        # Along a radius of the curved face, 10 mm before it and 2 mm behind.
        (BENT, (0.039, 0.0, -0.003), 0.01, (0.6, 0, 0.8)),
        (BENT, (0.0318, 0.0, -0.0126), -0.002, (0.6, 0, 0.8)),
        (BENT, (0.0, 0.0, 0.02), 0.02, (0, 0, 1)),
        # 8 and 6 mm from the end of the core's front, at x = 30 mm, z = -15 mm.
        (BENT, (0.038, 0.0, -0.009), 0.005, (0.8, 0, 0.6)),
        # 12 mm aside of the core's side, which has half a width of 5 mm, and 9 mm before its front.
        (BENT, (0.0354, 0.017, -0.0078), 0.010, (0.6 * 9 / 15, 12 / 15, 0.8 * 9 / 15)),
        (BENT, (0.04, 0.0, -0.03), 0.005, (1, 0, 0)),  # beside its flat end
        (BENT, (0.034, 0.0, -0.058), 0.0, (0.8, 0, -0.6)),  # on the rounding of its back
        (BENT, (0.0, 0.0, -0.07), 0.01, (0, 0, -1)),
        (BENT, (0.028, 0.0, -0.03), -0.007, (1, 0, 0)),  # in the core, 2 mm from its end
        (BENT, (0.0, 0.0, -0.008), -0.008, (0, 0, 1)),  # in the core, 3 mm from its front
    ],
)
def test_analytic_points(collider, point, expected, normal):
    found, direction = distance(collider, point)
    assert found == pytest.approx(expected, abs=1e-15)
    np.testing.assert_allclose(direction, normal, atol=1e-12)


@settings(deadline=None, max_examples=40)
@given(st.sampled_from([BENT, MICRO]), point)
def test_distance_to_a_convex_array_is_that_to_the_nearest_of_its_points(collider, where):
    """Against a search over its core's outline, for points outside of it."""
    *half, rounding, curvature = collider.offset_box
    radius = 1 / curvature
    x = np.linspace(-half[0], half[0], 20001)
    front = np.sqrt(radius**2 - x**2) - radius - rounding
    core = -2 * half[2] - rounding  # the back of it
    z = np.clip(where[2], core, front)
    aside = max(abs(where[1]) - half[1], 0.0)
    nearest = np.sqrt((where[0] - x) ** 2 + (where[2] - z) ** 2 + aside**2).min()
    if nearest > 1e-4:
        assert distance(collider, where)[0] == pytest.approx(nearest - rounding, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("collider", [BENT, MICRO])
def test_inside_its_core_a_convex_array_is_as_deep_as_the_nearest_side_of_it(collider):
    """Against 30,000 points on the core's outline in the image plane, and its two sides."""
    half_x, half_y, half_z, rounding, curvature = collider.offset_box
    back = -2 * half_z - rounding
    x = np.linspace(-half_x, half_x, 10001)
    front = np.sqrt(1 / curvature**2 - x**2) - 1 / curvature - rounding
    beside = np.linspace(back, front[0], 5001)
    outline = np.concatenate(
        [
            np.column_stack([x, front]),
            np.column_stack([x, np.full_like(x, back)]),
            np.column_stack([np.full_like(beside, -half_x), beside]),
            np.column_stack([np.full_like(beside, half_x), beside]),
        ]
    )
    random = np.random.default_rng(5).random((20_000, 3))
    points = (2 * random - 1) * [half_x, half_y, 0.0]
    points[:, 2] = back + random[:, 2] * (np.interp(points[:, 0], x, front) - back)
    in_plane, which = cKDTree(outline).query(points[:, [0, 2]])
    across = half_y - np.abs(points[:, 1])
    found, normal = measure_distances(collider, Pose(), points)
    # The outline's points are at most 6 µm apart.
    np.testing.assert_allclose(found, -np.minimum(in_plane, across) - rounding, atol=6e-6)
    # Where one side is clearly the nearest, the normal points to the nearest point of it.
    clear = (across > in_plane + 1e-5) & (in_plane > 1e-3)
    straight = (outline[which] - points[:, [0, 2]])[clear] / in_plane[clear, None]
    agrees = np.einsum("ij,ij->i", straight, normal[clear][:, [0, 2]])
    assert np.mean(agrees > 0.9999) > 0.99  # but for ties


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
    moved = pose.transform_points(np.array([where]))
    found, normal = measure_distances(collider, pose, moved)
    expected, direction = distance(collider, where)
    assert found[0] == pytest.approx(expected, abs=1e-12)
    if expected < -0.5 * collider.offset_box[3]:
        return  # near the core the last bit may decide between two nearest sides
    np.testing.assert_allclose(normal[0], pose.rotation @ direction, atol=1e-6)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Sphere(0.0), "radius: 0 m"),
        (lambda: Sphere(float("nan")), "radius: nan"),
        (lambda: Capsule(0.01, -1.0), "length: -1 m"),
        (lambda: Capsule("wide", 1.0), "radius: 'wide'"),
        (lambda: RoundedBox(0.05, 0.015, float("inf"), 0.003), "height: inf"),
        (lambda: RoundedBox(0.05, 0.015, 0.1, 0.008), "rounding: .* 0.0075 m"),
        (lambda: Convex(0.06, 0.02, 0.06, 0.005, -0.05), "radius: -0.05 m"),
        (lambda: Convex(0.06, 0.02, 0.06, 0.011, 0.05), "rounding: .* 0.01 m"),
        (lambda: Convex(0.06, 0.02, 0.06, 0.005, 0.03), "75 .* 0.0583 m"),
        (lambda: Convex(0.07, 0.02, 0.015, 0.005, 0.055), "height: .* 0.02 m"),
    ],
)
def test_impossible_dimensions_are_refused(make, words):
    with pytest.raises(ProbeError, match=words):
        make()
