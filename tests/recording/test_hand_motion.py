"""Motions of a hand and the demo's press: their speeds, rooms and phases, and the shipped bags."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from us_sim.errors import BagError
from us_sim.evaluation.hand.hand_motion import HASTES, KINDS, Room, hand_motion
from us_sim.recording.path import read_path
from us_sim.recording.press_and_slide import press_and_slide, pressing_path

BAGS = Path(__file__).resolve().parents[2] / "bags"

motions = st.tuples(
    st.sampled_from(sorted(KINDS)),
    st.sampled_from(sorted(HASTES)),
    st.integers(0, 2**32),
    st.floats(1.0, 8.0),
)
rooms = st.builds(
    Room,
    aside=st.floats(0.01, 0.05),
    across=st.floats(0.01, 0.05),
    above=st.floats(0.0, 0.02),
    deepest=st.floats(0.02, 0.05),
    tilt=st.floats(0.3, 1.0),
    yaw=st.floats(0.3, 1.5),
    edge=st.floats(0.03, 0.2),
)


def speeds(path, rate=60):
    """(K - 1,) m/s and rad/s, from pose to pose."""
    turns = Rotation.from_quat(path.orientations)
    moved = np.linalg.norm(np.diff(path.positions, axis=0), axis=1)
    return rate * moved, rate * (turns[:-1].inv() * turns[1:]).magnitude()


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(motions, rooms)
def test_the_median_speed_is_the_one_asked_for(motion, room):
    kind, haste, *_ = motion
    moved, turned = speeds(hand_motion(*motion, room))
    if KINDS[kind].moves:
        assert np.median(moved) == pytest.approx(HASTES[haste].speed, rel=1e-9)
    else:
        assert moved.max() == 0
    if KINDS[kind].turns:
        assert np.median(turned) == pytest.approx(HASTES[haste].turning, rel=1e-6)
    else:
        assert turned.max() == 0


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(motions, rooms)
def test_it_stays_in_its_room(motion, room):
    path = hand_motion(*motion, room)
    x, y, z = path.positions.T
    if KINDS[motion[0]].over_the_edge:
        assert 0.5 * room.edge <= x.min() <= x.max() <= 1.25 * room.edge
    else:
        assert np.abs(x).max() <= room.aside
    assert np.abs(y).max() <= room.across
    assert -room.above <= z.min() <= z.max() <= room.deepest
    yaw, *tilts = Rotation.from_quat(path.orientations).as_euler("ZXY").T
    assert np.abs(yaw).max() <= room.yaw + 1e-9
    assert np.abs(tilts).max() <= room.tilt + 1e-9
    np.testing.assert_allclose(np.linalg.norm(path.orientations, axis=1), 1, atol=1e-12)


def test_the_approach_comes_from_above_and_does_not_count():
    path = hand_motion("tilting", "brisk", 2, 1.0, approach=0.5)
    assert len(path) == 90
    assert path.positions[0] == pytest.approx([0, 0, -0.010])
    assert path.orientations[0] == pytest.approx([0, 0, 0, 1])
    alone = hand_motion("tilting", "brisk", 2, 1.0)
    np.testing.assert_allclose(path.positions[30:], alone.positions, atol=1e-15)
    np.testing.assert_allclose(path.orientations[30:], alone.orientations, atol=1e-12)


def test_the_bag_in_the_repository_is_this_path():
    made, kept = press_and_slide(), read_path(BAGS / "press_and_slide.mcap")
    assert (kept.topic, kept.frame_id) == ("/tracker/pose", "patient")
    for array in ("stamps", "log_times"):
        np.testing.assert_array_equal(getattr(kept, array), getattr(made, array))
    # Sines of different machines differ in their last bit.
    np.testing.assert_allclose(kept.positions, made.positions, rtol=0, atol=1e-15)
    np.testing.assert_allclose(kept.orientations, made.orientations, rtol=0, atol=1e-15)


def test_it_moves_as_smoothly_as_a_hand():
    path = press_and_slide(rate=600)
    velocity = np.diff(path.positions, axis=0) * 600
    acceleration = np.diff(velocity, axis=0) * 600
    # A minimum-jerk motion over a distance d in a time T peaks at 1.875 d/T and 5.774 d/T².
    assert np.abs(velocity).max() == pytest.approx(1.875 * 0.01 / 0.5, rel=1e-3)
    assert np.abs(acceleration).max() == pytest.approx(5.774 * 0.01 / 0.5**2, rel=1e-2)


def test_a_press_of_a_case_is_made_once_and_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("US_SIM_CACHE", str(tmp_path))
    file = pressing_path(7e-3)
    made = file.stat().st_mtime_ns
    assert read_path(file).positions[:, 2].max() == pytest.approx(7e-3)
    assert pressing_path(7e-3).stat().st_mtime_ns == made


@pytest.mark.parametrize("asked", [{"rate": 0}, {"depth": -0.001}])
def test_what_cannot_be_is_said(asked):
    with pytest.raises(BagError, match="cannot have"):
        press_and_slide(**asked)
