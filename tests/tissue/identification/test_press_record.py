"""Pairing of poses and wrenches, the sensor's delay, the choice of poses, and refused presses."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.errors import StiffnessError
from us_sim.tissue.identification.press_record import (
    choose_poses,
    evenly_spaced,
    find_delay,
    paired,
    stamped_alike,
    without_wrench,
)

STAMPS = np.arange(50) * 20_000_000  # ns
POSES = STAMPS, np.random.default_rng(0).normal(size=(50, 3)), np.tile([0.0, 0, 0, 1], (50, 1))


def ramp(stamps):
    """(K, 6): the force along z rises by 3 N/s, and the torque about x falls by 0.1 N m/s."""
    felt = np.zeros((len(stamps), 6))
    felt[:, 2], felt[:, 3] = 3e-9 * stamps, -1e-10 * stamps
    return felt


def test_wrenches_of_another_clock_are_taken_on_to_the_poses():
    felt_at = np.arange(-10, 400) * 2_700_000 + 1_234_567
    late = 31_000_000
    record = paired(POSES, (felt_at + late, ramp(felt_at)), tolerance=0.002, time_offset=0.031)
    assert np.allclose(record.wrenches, ramp(STAMPS), atol=1e-9)
    assert np.allclose(record.rates[:, 2], 3.0)
    assert record.channels.tolist() == [False, False, True, True, False, False]
    assert not record.same_stamps


def test_of_equal_stamps_the_last_counts():
    felt = np.concatenate([ramp(STAMPS) + 7.0, ramp(STAMPS)])
    record = paired(POSES, (np.concatenate([STAMPS, STAMPS]), felt), tolerance=0.001)
    assert np.array_equal(record.wrenches, ramp(STAMPS))
    assert record.same_stamps
    assert stamped_alike(POSES, (STAMPS, felt[50:]))


def test_poses_without_a_wrench_near_are_left_out_and_counted():
    record = paired(POSES, (STAMPS[10:40], ramp(STAMPS[10:40])), tolerance=0.001)
    assert record.unpaired == 20
    assert record.times[0] == pytest.approx(0.2)  # since the first pose of all


def test_poses_alone_are_a_record_without_channels():
    record = without_wrench(POSES)
    assert not record.channels.any()
    assert np.array_equal(record.positions, POSES[1])


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (lambda felt: felt.__setitem__((7, 2), np.nan), "1 of 50 wrenches.* 8"),
        (lambda felt: felt.__setitem__(slice(None), 0.4), "never changes"),
    ],
)
def test_what_is_no_force_is_refused(spoil, sentence):
    felt = ramp(STAMPS)
    spoil(felt)
    with pytest.raises(StiffnessError, match=sentence):
        paired(POSES, (STAMPS, felt), tolerance=0.01)


def test_clocks_that_never_met_are_refused():
    with pytest.raises(StiffnessError, match="0 of 50 poses"):
        paired(POSES, (STAMPS + 10**12, ramp(STAMPS)), tolerance=0.01)


def clearance(pose):
    """Of a flat surface at z = 0."""
    return -float(pose.position[2])


def pressed(depth, felt=None):
    """A record of a probe at depths (K,) m that feels 1 N/mm, 60 poses a second."""
    stamps = np.arange(len(depth)) * 16_666_667
    positions = np.column_stack([np.zeros((len(depth), 2)), depth])
    wrenches = np.zeros((len(depth), 6))
    wrenches[:, 2] = -1e3 * np.maximum(depth, 0.0) if felt is None else felt
    upright = np.tile([0.0, 0.0, 0.0, 1.0], (len(depth), 1))
    return paired((stamps, positions, upright), (stamps, wrenches), tolerance=0.01)


DOWN = np.linspace(-0.01, 0.01, 101)
HELD = np.concatenate([DOWN, np.full(500, 0.01), DOWN[::-1]])


def test_a_long_hold_takes_no_more_poses_than_one():
    record = pressed(HELD)
    chosen = choose_poses(record, clearance, 20)
    depths = record.positions[chosen.pressed, 2]
    assert 18 <= len(depths) <= 20
    assert (depths > 0.0099).sum() <= 3
    assert np.abs(np.diff(depths)).max() < 0.0013
    assert (clearance_of(record, chosen.free) > 0).all()


def clearance_of(record, numbers):
    return np.array([clearance(record.pose(k)) for k in numbers])


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=80), st.integers(2, 30))
def test_places_ascend_once_each_and_hold_both_ends(steps, count):
    way = np.cumsum(steps)
    places = evenly_spaced(way, count)
    assert (np.diff(places) > 0).all()
    assert len(places) <= count
    assert way[places[0]] == way[0]
    assert way[places[-1]] == way[-1]


@pytest.mark.parametrize(
    ("record", "sentence"),
    [
        (lambda: pressed(DOWN - 0.02, DOWN), "10.0 mm away"),
        (lambda: pressed(DOWN - 0.0097), "0.30 mm deep"),
        (lambda: pressed(np.repeat([-0.01, 0.005], 40)), "1 different poses"),
        (lambda: pressed(HELD, 0.01 * np.sin(np.arange(len(HELD)))), "go together"),
        (lambda: pressed(HELD, np.maximum(-4.0, -1e3 * np.maximum(HELD, 0))), "saturat"),
    ],
)
def test_what_is_no_press_is_refused(record, sentence):
    with pytest.raises(StiffnessError, match=sentence):
        choose_poses(record(), clearance, 20)


def test_an_unmoved_probe_that_feels_the_same_is_no_saturation():
    record = pressed(HELD)
    assert len(choose_poses(replace(record), clearance, 20).pressed)


TIMES = np.arange(0.0, 6.0, 1 / 60)


def depth(times):
    """m, of a press that goes in faster than it comes out."""
    return 0.012 * np.sin(np.pi * (np.clip(times, 0, 6) / 6) ** 0.8) ** 2 - 0.002


@pytest.mark.parametrize("late", [-0.08, 0.0, 0.035])
def test_it_is_found_though_the_sensor_has_noise_and_another_rate(late):
    felt_at = np.arange(-0.5, 6.5, 1 / 97)
    felt = np.random.default_rng(1).normal(size=(len(felt_at), 6)) * 0.02 + 0.7
    felt[:, 2] -= 4e4 * np.maximum(depth(felt_at), 0.0) ** 1.6
    stamps = np.round(1e9 * TIMES).astype(np.int64)
    poses = stamps, np.outer(depth(TIMES), [0, 0, 1]), np.tile([0.0, 0, 0, 1], (len(TIMES), 1))
    wrenches = np.round(1e9 * (felt_at + late)).astype(np.int64), felt
    found = find_delay(poses, wrenches, lambda pose: -pose.position[2], 0.3)
    assert found == pytest.approx(late, abs=0.004)


def test_a_press_that_only_goes_in_or_is_too_short_is_refused():
    stamps = np.round(1e9 * TIMES).astype(np.int64)
    poses = stamps, np.outer(TIMES, [0, 0, 1e-3]), np.tile([0.0, 0, 0, 1], (len(TIMES), 1))
    felt = np.outer(TIMES**2, [0.0, 0, -1, 0, 0, 0])
    with pytest.raises(StiffnessError, match="in and out"):
        find_delay(poses, (stamps, felt), lambda pose: -pose.position[2], 0.3)
    few = [array[:40] for array in poses]
    with pytest.raises(StiffnessError, match="too short"):
        find_delay(tuple(few), (stamps[:40], felt[:40]), lambda pose: -pose.position[2], 0.3)
