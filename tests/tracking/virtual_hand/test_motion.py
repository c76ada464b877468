"""The hand on its way: over the skin, not through it, and in the time that its limits allow."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_rest_surface import CYLINDER, RADIUS

from us_sim.geometry.se3 import rotation_between
from us_sim.tracking.virtual_hand.motion import HandSpeed, Motion
from us_sim.tracking.virtual_hand.stance import Stance


def at(angle: float, **held: float) -> Stance:
    return Stance([RADIUS * math.sin(angle), 0.0, RADIUS * (1 - math.cos(angle))], **held)


def test_a_jump_around_the_arm_goes_over_its_skin():
    motion = Motion(at(-1.0, press=0.003))
    motion.aim(at(1.0, press=0.003))
    for _ in range(60):
        position = motion.advance(1 / 60).pose(CYLINDER).position
        distance = math.hypot(position[0], position[2] - RADIUS)
        assert distance == pytest.approx(RADIUS - 0.003, abs=2e-5)
    assert motion.is_at_rest


@settings(max_examples=40, deadline=None)
@given(st.floats(0.0, 0.02), st.floats(-3, 3), st.floats(-1, 1), st.lists(st.floats(0.002, 0.05)))
def test_poses_do_not_depend_on_the_steps(press, rotation, fan, steps):
    coarse, fine = Motion(Stance()), Motion(Stance())
    goal = Stance([0.01, 0.02, 0.0], press, rotation, fan)
    coarse.aim(goal)
    fine.aim(goal)
    coarse.advance(sum(steps))
    for step in steps:
        fine.advance(step)
    first, second = coarse.stance.pose(CYLINDER), fine.stance.pose(CYLINDER)
    np.testing.assert_allclose(first.position, second.position, atol=1e-9)
    assert np.abs(rotation_between(first.orientation, second.orientation)).max() < 1e-6


def test_a_press_takes_as_long_as_its_speed_says():
    speed = HandSpeed(press=0.1, time_constant=0.02)
    motion = Motion(Stance(press=-0.05), speed)
    motion.aim(Stance(press=0.02))
    motion.advance(0.4)  # 40 mm further, less the lag of a time constant
    assert motion.stance.press == pytest.approx(-0.05 + 0.1 * (0.4 - 0.02), abs=1e-9)


def test_rotation_takes_the_shorter_way():
    motion = Motion(Stance(rotation=3.0))
    motion.aim(Stance(rotation=-3.0))
    motion.advance(0.05)
    assert abs(motion.stance.rotation) > 3.0
    motion.advance(1.0)
    assert motion.stance.rotation == pytest.approx(-3.0, abs=1e-6)


def test_who_takes_the_probe_begins_where_it_is():
    motion = Motion(Stance())
    motion.aim(Stance(press=0.02))
    motion.advance(0.03)
    motion.rest_at(Stance(press=-0.01))
    assert motion.is_at_rest
    assert motion.advance(0.1).press == -0.01
