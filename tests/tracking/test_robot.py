"""A robot arm against the bound of Hayes for a late force, and its own limits."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from us_sim.geometry.se3 import rotation_log
from us_sim.tracking.robot import Robot, RobotSettings

RATE = 250.0  # steps a second, many within a delay


def forces_on_tissue(stiffness, delay, damping, wanted=4.0, seconds=20.0):
    """(T,) N while the arm seeks a force on a spring whose force is felt late."""
    free = {"acceleration": 1000.0, "speed": 2.0, "lift": 2.0, "press": 0.2}
    robot = Robot(RobotSettings(damping=damping, rate=RATE, **free))
    late = round(delay * RATE)
    forces = [0.0] * (late + 1)
    start = robot.pose.position[2]  # the spring begins where the arm is
    for step in range(round(seconds * RATE)):
        time = step / RATE
        robot.update_force(time, forces[-1 - late])
        robot.request_force(time, wanted)
        # Pulled, too: the bound is of a linear spring.
        forces.append(stiffness * (robot.move_until(time).position[2] - start))
    return np.array(forces)


def test_a_late_force_settles_below_the_bound_and_not_above():
    stiffness, delay = 2000.0, 0.1
    critical = stiffness * delay / (math.pi / 2)
    for factor, settles in ((1.15, True), (0.87, False)):
        forces = forces_on_tissue(stiffness, delay, factor * critical)
        swing = np.abs(forces[-500:] - 4.0).max()  # N, in the last two seconds
        assert swing < 0.1 if settles else swing > 4.0


@pytest.mark.slow
def test_the_least_damping_without_overshoot():
    stiffness, delay = 1000.0, 0.1
    least = math.e * stiffness * delay
    assert forces_on_tissue(stiffness, delay, 1.05 * least).max() <= 4.0 + 1e-3
    assert forces_on_tissue(stiffness, delay, 0.6 * least).max() > 4.1


def test_the_defaults_press_stiff_tissue_without_overshoot_four_frames_late():
    """The bound holds, and the limits of speed and acceleration do not spoil it."""
    settings, stiffness, late = RobotSettings(), 2000.0, 4
    assert settings.damping >= math.e * stiffness * late / settings.rate
    robot, forces = Robot(settings), [0.0] * (late + 1)
    for step in range(600):
        time = step / settings.rate
        robot.update_force(time, forces[-1 - late])
        robot.request_force(time, 20.0)
        forces.append(stiffness * max(robot.move_until(time).position[2], 0.0))
    assert max(forces) <= 20.0 + 0.01
    assert forces[-60:] == pytest.approx([20.0] * 60, abs=0.01)


twists = st.lists(st.floats(-5.0, 5.0), min_size=6, max_size=6).map(np.array)


@given(st.lists(st.tuples(twists, st.floats(0.001, 0.5)), min_size=1, max_size=40))
def test_no_command_takes_the_arm_beyond_its_limits(commands):
    settings = RobotSettings()
    robot = Robot(settings)
    time, before, velocity = 0.0, robot.move_until(0.0), np.zeros(6)
    for twist, passed in commands:
        robot.request_velocity(time, twist)
        time += passed
        pose = robot.move_until(time)
        x, y, z = pose.position
        assert max(abs(x), abs(y)) <= settings.aside
        assert -settings.lift <= z <= settings.press
        angle = 2 * math.acos(min(abs(pose.orientation[3]), 1.0))
        assert angle <= settings.lean + 1e-9
        step = before.inverse() @ pose
        turn = rotation_log(step.orientation)
        moved = np.concatenate([step.position, turn]) / min(passed, 0.1)
        assert np.linalg.norm(moved[:3]) <= settings.speed * (1 + 1e-6)
        assert np.linalg.norm(moved[3:]) <= settings.angular_speed * (1 + 1e-6)
        before, velocity = pose, moved
    assert np.isfinite(velocity).all()


def test_the_arm_speeds_up_slowly_and_stops_when_nothing_is_asked_any_more():
    robot = Robot(RobotSettings(acceleration=0.1, speed=0.02))
    twist = np.array([0.02, 0, 0, 0, 0, 0])
    places = []
    for step in range(200):
        time = step / 100
        if time < 1.0:
            robot.request_velocity(time, twist)
        places.append(robot.move_until(time).position[0])
    speeds = np.diff(places) * 100
    assert speeds.max() == pytest.approx(0.02)
    assert np.abs(np.diff(speeds)).max() <= 0.1 / 100 + 1e-9
    assert speeds[110:120] == pytest.approx(0.02)  # until the time is out
    assert speeds[-1] == 0.0
    assert robot.action == "at rest"


def test_a_velocity_along_the_patients_axes_is_one_however_the_probe_is_turned():
    robot = Robot(RobotSettings(acceleration=1000.0, angular_acceleration=1e4))
    for step in range(3):
        robot.request_velocity(0.1 * step, np.array([0, 0, 0, 0.2, 0.4, 0.3]))
        before = robot.move_until(0.1 * step)
    robot.request_velocity(0.2, np.array([0.02, 0.01, 0, 0, 0, 0]), in_patient=True)
    after = robot.move_until(0.3)
    assert np.degrees(2 * math.acos(before.orientation[3])) > 5
    np.testing.assert_allclose(after.position - before.position, [0.002, 0.001, 0], atol=1e-9)
    np.testing.assert_allclose(after.orientation, before.orientation, atol=1e-9)


def test_a_force_is_not_sought_where_none_is_felt():
    robot = Robot(RobotSettings())
    robot.request_force(0.0, 4.0)
    robot.update_force(0.0, 0.0)
    robot.move_until(0.0)
    assert robot.move_until(0.1).position[2] > -RobotSettings().lift
    assert robot.action == "seeking 4.0 N"
    robot.request_force(1.0, 4.0)
    for step in range(30):
        robot.move_until(1.0 + step / 100)
    assert robot.action == "without a felt force"
    assert robot.move_until(1.3).position[2] == robot.move_until(1.31).position[2]
