"""Stances as poses and back, on surfaces where both are known."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_rest_surface import CYLINDER, PLANE, RADIUS, SPHERE

from us_sim.errors import PoseError
from us_sim.geometry.se3 import rotation_between
from us_sim.tracking.virtual_hand.stance import DEEPEST, STEEPEST, Stance

angles = st.floats(-STEEPEST, STEEPEST)
turns = st.floats(-math.pi, math.pi)


def test_upright_on_a_cylinder_the_array_stays_across_it():
    angle = math.radians(40)
    point = [RADIUS * math.sin(angle), 0.01, RADIUS * (1 - math.cos(angle))]
    pose = Stance(point, press=0.004).pose(CYLINDER)
    across, elevation, inwards = pose.rotation.T
    np.testing.assert_allclose(across, [math.cos(angle), 0, math.sin(angle)], atol=1e-3)
    np.testing.assert_allclose(elevation, [0, 1, 0], atol=1e-3)
    np.testing.assert_allclose(inwards, [-math.sin(angle), 0, math.cos(angle)], atol=1e-3)
    np.testing.assert_allclose(pose.position, point + 0.004 * inwards, atol=2e-5)


def test_each_angle_turns_about_its_own_axis():
    quarter = math.radians(30)
    c, s = math.cos(quarter), math.sin(quarter)
    x, y, z = Stance(fan=quarter).pose(PLANE).rotation.T
    np.testing.assert_allclose([x, y, z], [[1, 0, 0], [0, c, s], [0, -s, c]], atol=1e-12)
    x, y, z = Stance(rock=quarter).pose(PLANE).rotation.T
    np.testing.assert_allclose([x, y, z], [[c, 0, -s], [0, 1, 0], [s, 0, c]], atol=1e-12)
    x, y, z = Stance(rotation=quarter).pose(PLANE).rotation.T
    np.testing.assert_allclose([x, y, z], [[c, s, 0], [-s, c, 0], [0, 0, 1]], atol=1e-12)


@settings(max_examples=40, deadline=None)
@given(st.floats(0.2, 2.9), turns, st.floats(-0.02, 0.02), turns, angles, angles)
def test_the_way_back_from_a_pose(polar, turn, press, rotation, fan, rock):
    outwards = [math.sin(polar) * math.cos(turn), math.sin(polar) * math.sin(turn)]
    point = RADIUS * np.array([*outwards, math.cos(polar)])
    pose = Stance(point, press, rotation, fan, rock).pose(SPHERE)
    found = Stance.of(pose, SPHERE)
    again = found.pose(SPHERE)
    np.testing.assert_allclose(again.position, pose.position, atol=1e-8)
    assert np.abs(rotation_between(again.orientation, pose.orientation)).max() < 1e-6
    assert found.press == pytest.approx(press, abs=1e-5)
    assert math.remainder(found.rotation - rotation, math.tau) == pytest.approx(0, abs=2e-3)
    assert (found.fan, found.rock) == pytest.approx((fan, rock), abs=2e-3)


def test_a_probe_that_lies_on_its_side_has_a_stance_too():
    pose = Stance(rotation=0.3, fan=math.pi / 2).pose(PLANE)
    again = Stance.of(pose, PLANE).pose(PLANE)
    assert np.abs(rotation_between(again.orientation, pose.orientation)).max() < 1e-6


def test_sliding_is_along_the_probes_own_axes():
    turned = Stance(rotation=math.pi / 2)
    np.testing.assert_allclose(turned.slid(PLANE, 0.01, 0.0).point, [0, 0.01, 0], atol=1e-12)
    np.testing.assert_allclose(turned.slid(PLANE, 0.0, 0.01).point, [-0.01, 0, 0], atol=1e-12)
    bent = Stance().slid(CYLINDER, RADIUS * 0.5, 0.0).point
    np.testing.assert_allclose(
        bent, [RADIUS * math.sin(0.5), 0, RADIUS * (1 - math.cos(0.5))], atol=2e-4
    )


def test_home_is_above_the_origin_or_in_the_middle():
    np.testing.assert_allclose(Stance.home(PLANE, 0.001).point, [0, 0, 0])
    assert Stance.home(SPHERE, 0.0).point[2] == pytest.approx(-RADIUS, abs=1e-5)


def test_no_hand_presses_or_turns_without_end():
    held = Stance(press=1.0, rotation=3.5, fan=-2.0, rock=2.0).within_reach()
    assert (held.press, held.fan, held.rock) == (DEEPEST, -STEEPEST, STEEPEST)
    assert held.rotation == pytest.approx(3.5 - math.tau)


@pytest.mark.parametrize("wrong", [{"press": math.nan}, {"point": [0, 0]}, {"fan": math.inf}])
def test_numbers_that_are_none_are_refused(wrong):
    with pytest.raises(PoseError, match="not finite, or not seven"):
        Stance(**wrong)
