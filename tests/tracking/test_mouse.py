"""The 6-DOF mouse: motions known beforehand, no step, no wind-up, bad messages refused."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.errors import TrackingError
from us_sim.geometry import se3
from us_sim.tracking.mouse import SixDofMouse
from us_sim.tracking.settings import SixDofMouseSettings

MS = 1_000_000
PLAIN = {
    "speed": (0.1, 0.1, 0.1),
    "angular_speed": (1.0, 1.0, 1.0),
    "dead_band": 0.0,
    "home": (0.0, 0.0, 0.0),
}


def mouse(**changed):
    return SixDofMouse(SixDofMouseSettings(**{**PLAIN, **changed}))


def axes(**deflections):
    names = ("x", "y", "z", "rx", "ry", "rz")
    return [deflections.get(name, 0.0) for name in names]


def drive(device, deflection, seconds, *, rate=100, start=0, buttons=()):
    for tick in range(round(seconds * rate) + 1):
        probe = device.move_probe(deflection, buttons, start + round(tick * 1000 / rate) * MS)
    return probe


@pytest.mark.parametrize("rate", [50, 125, 1000])
def test_velocity_is_integrated_over_time_at_any_rate(rate):
    probe = drive(mouse(), axes(x=0.5, z=-0.25), 1.0, rate=rate)
    np.testing.assert_allclose(probe.pose.position, [0.05, 0.0, -0.025], atol=1e-12)
    assert probe.stamp == 1000 * MS


def test_in_the_probes_frame_speed_and_turn_make_a_circle():
    probe = drive(mouse(), axes(x=1.0, rz=1.0), 1.0)
    radius = 0.1 / 1.0  # m/s over rad/s
    np.testing.assert_allclose(
        probe.pose.position, [radius * math.sin(1.0), radius * (1 - math.cos(1.0)), 0], atol=1e-12
    )
    np.testing.assert_allclose(se3.rotation_log(probe.pose.orientation), [0, 0, 1], atol=1e-12)


def test_a_tilted_probe_moves_along_its_own_axes():
    device = mouse(angular_speed=(math.pi, 1.0, 1.0))
    drive(device, axes(rx=1.0), 0.5)  # a quarter turn: its z is the patient's -y
    probe = drive(device, axes(z=1.0), 0.5, start=1000 * MS)
    np.testing.assert_allclose(probe.pose.position, [0.0, -0.05, 0.0], atol=1e-12)


def test_a_long_gap_is_not_travelled():
    device = mouse()
    device.move_probe(axes(x=1.0), (), 0)
    device.move_probe(axes(x=1.0), (), 100 * MS)
    probe = device.move_probe(axes(x=1.0), (), 5000 * MS)
    assert probe.pose.position[0] == pytest.approx(0.01)
    probe = device.move_probe(axes(x=1.0), (), 1000 * MS)  # the clock was set back
    assert probe.pose.position[0] == pytest.approx(0.01)
    assert device.move_probe(axes(x=1.0), (), 1050 * MS).pose.position[0] == pytest.approx(0.015)


@given(st.floats(-1.0, 1.0), st.floats(0.0, 0.9))
@settings(max_examples=40, deadline=None)
def test_the_dead_band_has_no_step_at_its_edge_and_full_deflection_stays_full(deflection, band):
    device = mouse(dead_band=band)
    device.move_probe(axes(x=deflection), (), 0)
    place = device.move_probe(axes(x=deflection), (), 100 * MS).pose.position[0] / 0.01
    expected = math.copysign(max(abs(deflection) - band, 0) / (1 - band), deflection)
    assert place == pytest.approx(expected, abs=1e-12)


def test_the_clutch_stops_the_probe():
    device = mouse(clutch_button=1, reset_button=0)
    drive(device, axes(x=1.0), 0.5)
    drive(device, axes(x=1.0), 0.5, start=510 * MS, buttons=[0, 1])
    # The usual driver lists no buttons with a mere movement: the clutch is still held.
    probe = drive(device, axes(x=1.0), 0.5, start=1020 * MS)
    assert probe.pose.position[0] == pytest.approx(0.05)
    probe = drive(device, axes(x=1.0), 0.1, start=1530 * MS, buttons=[0, 0])
    assert probe.pose.position[0] == pytest.approx(0.05 + 0.011)


def test_the_reset_button_brings_the_probe_home():
    device = mouse(reset_button=2, home=(0.01, 0.0, -0.02))
    drive(device, axes(x=1.0, rx=1.0), 0.5)
    probe = device.move_probe(axes(x=1.0), [0, 0, 1], 510 * MS)
    np.testing.assert_array_equal(probe.pose.position, [0.01, 0.0, -0.02])
    np.testing.assert_array_equal(probe.pose.orientation, [0, 0, 0, 1])


def test_the_probe_stops_at_the_workspace_and_comes_back_at_once():
    device = mouse(workspace_low=(-0.02, -0.02, -0.02), workspace_high=(0.02, 0.02, 0.02))
    probe = drive(device, axes(x=1.0, y=-0.1), 1.0)
    np.testing.assert_allclose(probe.pose.position, [0.02, -0.01, 0.0], atol=1e-12)
    device.move_probe(axes(x=-1.0), (), 1010 * MS)
    probe = device.move_probe(axes(x=-1.0), (), 1020 * MS)
    assert probe.pose.position[0] == pytest.approx(0.02 - 0.001)


@pytest.mark.parametrize(
    ("bad", "word"),
    [
        ([0.0] * 5, "5 axes"),
        (axes(y=math.nan), "finite"),
        (axes(rx=-1.4), "-1.4"),
    ],
)
def test_a_message_that_cannot_be_used_changes_nothing(bad, word):
    device = mouse()
    drive(device, axes(x=1.0), 0.5)
    assert device.move_probe(bad, [1], 505 * MS) is None
    assert word in device.last_problem
    probe = device.move_probe(axes(x=1.0), (), 510 * MS)
    assert probe.pose.position[0] == pytest.approx(0.051)


@pytest.mark.parametrize(
    ("setting", "word"),
    [
        ({"speed": (0.1, 0.1)}, "3 values"),
        ({"axes": (0, 1, 2, 3, 4, 4)}, "different"),
        ({"clutch_button": 1}, "reset_button"),
        ({"home": (1.0, 0.0, 0.0)}, "workspace"),
    ],
)
def test_settings_that_make_no_sense_are_refused(setting, word):
    with pytest.raises(TrackingError, match=word):
        SixDofMouseSettings(**setting)
