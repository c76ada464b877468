"""Poses are spread over the way of a press; what is no press of this tissue is refused."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.errors import StiffnessError
from us_sim.tissue.identification.press_record import choose_poses, paired, spread


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
    places = spread(way, count)
    assert (np.diff(places) > 0).all()
    assert len(places) <= count
    assert way[places[0]] == way[0]
    assert way[places[-1]] == way[-1]


@pytest.mark.parametrize(
    ("record", "sentence"),
    [
        (lambda: pressed(DOWN - 0.02, DOWN), "10.0 mm away from it at its nearest"),
        (lambda: pressed(DOWN - 0.0097), "0.30 mm deep in it at its deepest"),
        (lambda: pressed(np.repeat([-0.01, 0.005], 40)), "1 different poses press the tissue"),
        (lambda: pressed(HELD, 0.01 * np.sin(np.arange(len(HELD)))), "do not go together"),
        (lambda: pressed(HELD, np.maximum(-4.0, -1e3 * np.maximum(HELD, 0))), "the sensor saturat"),
    ],
)
def test_what_is_no_press_is_refused(record, sentence):
    with pytest.raises(StiffnessError, match=sentence):
        choose_poses(record(), clearance, 20)


def test_an_unmoved_probe_that_feels_the_same_is_no_saturation():
    record = pressed(HELD)
    assert len(choose_poses(replace(record), clearance, 20).pressed)
