"""The laws of a movement that must be the same however finely time is cut."""

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.tracking.virtual_hand.approach import Approach

SPEED, TAU = 0.25, 0.02
goals = st.lists(st.floats(-0.2, 0.2), min_size=3, max_size=3).map(np.array)
steps = st.lists(st.floats(1e-4, 0.1), min_size=1, max_size=12)


def towards(goal):
    approach = Approach(np.zeros(3), SPEED, TAU)
    approach.goal = goal
    return approach


@settings(max_examples=40, deadline=None)
@given(goals, steps, goals, steps)
def test_the_path_does_not_depend_on_the_steps(first, early, second, late):
    coarse, fine = towards(first), towards(first)
    coarse.advance(sum(early))
    for step in early:
        fine.advance(step)
    np.testing.assert_allclose(fine.place, coarse.place, atol=1e-12)
    coarse.goal = fine.goal = second
    coarse.advance(sum(late))
    for step in late:
        fine.advance(step)
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


@settings(max_examples=40, deadline=None)
@given(goals)
def test_it_ends_at_the_goal(goal):
    approach = towards(goal)
    approach.advance(float(np.linalg.norm(goal)) / SPEED + 25 * TAU)
    assert approach.distance() < 1e-9


def test_near_the_goal_it_is_critically_damped():
    approach = towards(np.array([1e-3, 0.0, 0.0]))  # less than speed times time constant
    for k in range(1, 20):
        s = 0.25 * k
        reached = 1e-3 * (1.0 - (1.0 + s) * math.exp(-s))  # the step response
        assert abs(approach.advance(0.25 * TAU)[0] - reached) < 1e-15


def test_it_moves_within_the_first_sixtieth_of_a_second():
    approach = towards(np.array([0.02, 0.0, 0.0]))
    t = 1 / 60
    far = SPEED * (t - TAU * (1 - math.exp(-t / TAU)))  # a first-order lag behind a ramp
    assert abs(approach.advance(t)[0] - far) < 1e-15
    assert far > 1e-3
