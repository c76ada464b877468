"""Feet on a plane, a cylinder and a sphere, whose closest points are known.

The laws of a movement that must be the same however finely time is cut.

The hand on its way: over the skin, not through it, and in the time that its limits allow.

Stances as poses and back, on surfaces where both are known.
"""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.errors import PoseError
from us_sim.geometry.se3 import rotation_between
from us_sim.skin.surface import bent_surface, plane_surface
from us_sim.tracking.virtual_hand import (
    DEEPEST,
    STEEPEST,
    Approach,
    Stance,
    StanceMotion,
    StandingSurface,
)

RADIUS = 0.045


def cylinder() -> StandingSurface:
    """Half a cylinder about the line x = 0, z = RADIUS, along y; facets of 2 degrees."""
    size = (math.pi * RADIUS, 0.1)
    sheet = bent_surface(size, math.radians(2) * RADIUS, flat_width=0.0, radius=RADIUS)
    return StandingSurface(sheet.vertices, sheet.triangles)


def sphere(steps: int = 90) -> StandingSurface:
    """About the origin, by latitude and longitude."""
    polar, turn = np.linspace(0, math.pi, steps + 1), np.arange(2 * steps) * math.pi / steps
    grid = np.stack(
        [
            np.outer(np.sin(polar), np.cos(turn)),
            np.outer(np.sin(polar), np.sin(turn)),
            np.outer(np.cos(polar), np.ones_like(turn)),
        ],
        axis=-1,
    )
    index = np.arange(grid.shape[0] * grid.shape[1]).reshape(grid.shape[:2])
    a, b = index[:-1], index[1:]
    c, d = np.roll(b, -1, axis=1), np.roll(a, -1, axis=1)
    triangles = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
    return StandingSurface(RADIUS * grid.reshape(-1, 3), triangles)


def plane(half=0.1):
    """The square of z = 0 around the origin, with the body at z > 0."""
    corners = half * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    return StandingSurface(corners, np.array([[0, 2, 1], [0, 3, 2]]))


PLANE, CYLINDER, SPHERE = plane(), cylinder(), sphere()
FACET = RADIUS * (1 - math.cos(math.radians(1)))  # how deep a facet of 2 degrees lies below


@settings(max_examples=40, deadline=None)
@given(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))
def test_on_a_plane_the_foot_is_straight_below(x, y, z):
    foot = PLANE.find_closest(np.array([x, y, z]))
    np.testing.assert_allclose(foot.point, [x, y, 0.0], atol=1e-12)
    np.testing.assert_allclose(foot.normal, [0.0, 0.0, -1.0])


@settings(max_examples=40, deadline=None)
@given(st.floats(-1.3, 1.3), st.floats(-0.045, 0.045), st.floats(-0.02, 0.05))
def test_on_a_cylinder_the_foot_is_on_the_radius(angle, y, height):
    outwards = np.array([math.sin(angle), 0.0, -math.cos(angle)])
    axis = np.array([0.0, y, RADIUS])
    foot = CYLINDER.find_closest(axis + (RADIUS + height) * outwards)
    np.testing.assert_allclose(foot.normal, outwards, atol=math.radians(1.05))
    # On a facet the closest point is up to the facet's slope times the height beside the radius.
    beside = math.radians(1.05) * abs(height) + FACET
    np.testing.assert_allclose(foot.point, axis + RADIUS * outwards, atol=beside)


def test_the_normal_does_not_jump_at_the_edges_of_facets():
    way = np.linspace(-1.2, 1.2, 4001)
    normals = np.array(
        [
            CYLINDER.find_closest(
                np.array([RADIUS * math.sin(a), 0.003, RADIUS - RADIUS * math.cos(a)])
            ).normal
            for a in way[::10]
        ]
    )
    turns = np.degrees(np.arccos(np.clip((normals[1:] * normals[:-1]).sum(axis=1), -1, 1)))
    assert turns.max() < 1.5 * np.degrees(way[10] - way[0])  # facets alone would jump by 2 degrees


@settings(max_examples=40, deadline=None)
@given(st.floats(-0.04, 0.04), st.floats(-0.04, 0.04))
def test_above_a_place_the_foot_is_straight_below(x, y):
    foot = CYLINDER.find_top(x, y)
    np.testing.assert_allclose(foot.point[:2], [x, y], atol=1e-6)
    assert foot.point[2] == pytest.approx(RADIUS - math.sqrt(RADIUS**2 - x**2), abs=2.2 * FACET)


def test_a_short_slide_keeps_its_length_and_bends_with_the_skin():
    slid = at(0.3).slide_along(CYLINDER, 0.002, -0.004)
    angle = math.atan2(slid.point[0], RADIUS - slid.point[2])
    assert RADIUS * (angle - 0.3) == pytest.approx(0.002, abs=5e-5)
    assert slid.point[1] == pytest.approx(-0.004, abs=5e-5)


def test_the_closest_point_is_that_of_all_triangles_tried_one_by_one():
    sheet = plane_surface((0.02, 0.02), 0.002)
    generator = np.random.default_rng(4)
    vertices = sheet.vertices + generator.normal(scale=3e-4, size=sheet.vertices.shape)
    surface = StandingSurface(vertices, sheet.triangles)
    weights = generator.dirichlet([1, 1, 1], size=400)
    for point in generator.uniform(-0.015, 0.015, size=(20, 3)):
        samples = np.einsum("wc,tcx->twx", weights, vertices[sheet.triangles])
        least = np.linalg.norm(samples - point, axis=2).min()
        distance = np.linalg.norm(surface.find_closest(point).point - point)
        assert distance <= least + 1e-12
        assert distance == pytest.approx(least, abs=3e-4)


SPEED, TAU = 0.25, 0.02
goals = st.lists(st.floats(-0.2, 0.2), min_size=3, max_size=3).map(np.array)
steps = st.lists(st.floats(1e-4, 0.1), min_size=1, max_size=12)


def advance_both(coarse, fine, steps):
    coarse.advance(sum(steps))
    for step in steps:
        fine.advance(step)


def towards(goal):
    approach = Approach(np.zeros(3), SPEED, TAU)
    approach.goal = goal
    return approach


@settings(max_examples=40, deadline=None)
@given(goals, steps, goals, steps)
def test_the_path_does_not_depend_on_the_steps(first, early, second, late):
    coarse, fine = towards(first), towards(first)
    advance_both(coarse, fine, early)
    np.testing.assert_allclose(fine.place, coarse.place, atol=1e-12)
    coarse.goal = fine.goal = second
    advance_both(coarse, fine, late)
    np.testing.assert_allclose(fine.place, coarse.place, atol=1e-12)


@settings(max_examples=40, deadline=None)
@given(goals, steps)
def test_from_rest_it_goes_straight_to_the_goal_and_never_beyond(goal, times):
    approach, length = towards(goal), float(np.linalg.norm(goal))
    passed = 0.0
    for step in times:
        place = approach.advance(step)
        along = float(place @ goal) / length if length else 0.0
        assert passed - 1e-12 <= along <= length + 1e-12
        aside = place - (along / length * goal if length else 0.0)
        np.testing.assert_allclose(aside, 0.0, atol=1e-12)
        passed = along


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(goals, st.floats(1e-3, 0.2)), min_size=1, max_size=6))
def test_speed_and_acceleration_have_their_limits_whatever_the_goals(course):
    approach, step = towards(course[0][0]), 1e-3
    places = [approach.place]
    for goal, duration in course:
        approach.goal = goal
        places += [approach.advance(step) for _ in range(math.ceil(duration / step))]
    velocities = np.diff(places, axis=0) / step
    assert np.linalg.norm(velocities, axis=1).max(initial=0.0) <= SPEED * (1 + 1e-9)
    accelerations = np.diff(velocities, axis=0) / step
    assert np.linalg.norm(accelerations, axis=1).max(initial=0.0) <= 2 * SPEED / TAU * (1 + 1e-6)


def at(angle: float, **held: float) -> Stance:
    return Stance([RADIUS * math.sin(angle), 0.0, RADIUS * (1 - math.cos(angle))], **held)


def test_a_jump_around_the_arm_goes_over_its_skin():
    motion = StanceMotion(at(-1.0, press=0.003))
    motion.aim_at(at(1.0, press=0.003))
    for _ in range(60):
        position = motion.advance(1 / 60).compute_pose(CYLINDER).position
        distance = math.hypot(position[0], position[2] - RADIUS)
        assert distance == pytest.approx(RADIUS - 0.003, abs=2e-5)
    assert motion.is_at_rest


angles = st.floats(-STEEPEST, STEEPEST)
turns = st.floats(-math.pi, math.pi)


def test_upright_on_a_cylinder_the_array_stays_across_it():
    angle = math.radians(40)
    point = [RADIUS * math.sin(angle), 0.01, RADIUS * (1 - math.cos(angle))]
    pose = Stance(point, press=0.004).compute_pose(CYLINDER)
    across, elevation, inwards = pose.rotation.T
    np.testing.assert_allclose(across, [math.cos(angle), 0, math.sin(angle)], atol=1e-3)
    np.testing.assert_allclose(elevation, [0, 1, 0], atol=1e-3)
    np.testing.assert_allclose(inwards, [-math.sin(angle), 0, math.cos(angle)], atol=1e-3)
    np.testing.assert_allclose(pose.position, point + 0.004 * inwards, atol=2e-5)


def test_each_angle_turns_about_its_own_axis():
    quarter = math.radians(30)
    c, s = math.cos(quarter), math.sin(quarter)
    for name, axes in (
        ("fan", [[1, 0, 0], [0, c, s], [0, -s, c]]),
        ("rock", [[c, 0, -s], [0, 1, 0], [s, 0, c]]),
        ("rotation", [[c, s, 0], [-s, c, 0], [0, 0, 1]]),
    ):
        rotation = Stance(**{name: quarter}).compute_pose(PLANE).rotation
        np.testing.assert_allclose(rotation.T, axes, atol=1e-12)


@settings(max_examples=40, deadline=None)
@given(st.floats(0.2, 2.9), turns, st.floats(-0.02, 0.02), turns, angles, angles)
def test_the_way_back_from_a_pose(polar, turn, press, rotation, fan, rock):
    outwards = [math.sin(polar) * math.cos(turn), math.sin(polar) * math.sin(turn)]
    point = RADIUS * np.array([*outwards, math.cos(polar)])
    pose = Stance(point, press, rotation, fan, rock).compute_pose(SPHERE)
    found = Stance.from_pose(pose, SPHERE)
    again = found.compute_pose(SPHERE)
    np.testing.assert_allclose(again.position, pose.position, atol=1e-8)
    assert np.abs(rotation_between(again.orientation, pose.orientation)).max() < 1e-6
    assert found.press == pytest.approx(press, abs=1e-5)
    assert math.remainder(found.rotation - rotation, math.tau) == pytest.approx(0, abs=2e-3)
    assert (found.fan, found.rock) == pytest.approx((fan, rock), abs=2e-3)


def test_no_hand_presses_or_turns_without_end():
    held = Stance(press=1.0, rotation=3.5, fan=-2.0, rock=2.0).clip_to_reach()
    assert (held.press, held.fan, held.rock) == (DEEPEST, -STEEPEST, STEEPEST)
    assert held.rotation == pytest.approx(3.5 - math.tau)


@pytest.mark.parametrize("wrong", [{"press": math.nan}, {"point": [0, 0]}, {"fan": math.inf}])
def test_numbers_that_are_none_are_refused(wrong):
    with pytest.raises(PoseError, match="not finite"):
        Stance(**wrong)
