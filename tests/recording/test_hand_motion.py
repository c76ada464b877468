"""Motions of a hand and the demo's press: their speeds, rooms and phases, and the shipped bags."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from us_sim.evaluation.hand.hand_motion import APPROACH, HASTES, KINDS, RATE, make_hand_motion
from us_sim.recording.path import read_path
from us_sim.recording.press_and_slide import find_pressing_path, make_press_and_slide

BAGS = Path(__file__).resolve().parents[2] / "bags"

motions = st.tuples(
    st.sampled_from(sorted(KINDS)),
    st.sampled_from(sorted(HASTES)),
    st.integers(0, 2**32),
    st.floats(1.0, 8.0),
)
APPROACHING = round(APPROACH * RATE)  # poses


def arrays(poses):
    """Positions (K, 3) m, and rotations."""
    return (
        np.array([pose.position for pose in poses]),
        Rotation.from_quat([pose.orientation for pose in poses]),
    )


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(motions)
def test_the_median_speed_is_the_one_asked_for(motion):
    kind, haste = KINDS[motion[0]], HASTES[motion[1]]
    positions, turns = arrays(make_hand_motion(*motion)[APPROACHING:])
    moved = RATE * np.linalg.norm(np.diff(positions, axis=0), axis=1)
    turned = RATE * (turns[:-1].inv() * turns[1:]).magnitude()
    speed = haste.speed if kind.low != kind.high else 0.0
    assert np.median(moved) == pytest.approx(speed, rel=1e-9)
    assert np.median(turned) == pytest.approx(haste.turning * any(kind.turn), rel=1e-6)


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(motions)
def test_it_stays_in_its_room(motion):
    kind = KINDS[motion[0]]
    positions, turns = arrays(make_hand_motion(*motion)[APPROACHING:])
    assert (positions >= np.array(kind.low) - 1e-12).all()
    assert (positions <= np.array(kind.high) + 1e-12).all()
    assert (np.abs(turns.as_euler("ZXY")) <= np.array(kind.turn) + 1e-9).all()


def test_the_approach_comes_from_above():
    poses = make_hand_motion("tilting", "brisk", 2, 1.0)
    assert len(poses) == 90
    assert poses[0].position == pytest.approx([0, 0, -0.010])
    assert poses[0].orientation == pytest.approx([0, 0, 0, 1])
    assert poses[APPROACHING].position == pytest.approx([0, 0, 0.0075])


def test_the_bag_in_the_repository_is_this_path():
    made, kept = make_press_and_slide(), read_path(BAGS / "press_and_slide.mcap")
    assert (kept.topic, kept.frame_id) == ("/tracker/pose", "patient")
    for array in ("stamps", "log_times"):
        np.testing.assert_array_equal(getattr(kept, array), getattr(made, array))
    # Sines of different machines differ in their last bit.
    np.testing.assert_allclose(kept.positions, made.positions, rtol=0, atol=1e-15)
    np.testing.assert_allclose(kept.orientations, made.orientations, rtol=0, atol=1e-15)


def test_it_moves_as_smoothly_as_a_hand():
    path = make_press_and_slide(rate=600)
    velocity = np.diff(path.positions, axis=0) * 600
    acceleration = np.diff(velocity, axis=0) * 600
    # A minimum-jerk motion over a distance d in a time T peaks at 1.875 d/T and 5.774 d/T².
    assert np.abs(velocity).max() == pytest.approx(1.875 * 0.01 / 0.5, rel=1e-3)
    assert np.abs(acceleration).max() == pytest.approx(5.774 * 0.01 / 0.5**2, rel=1e-2)


def test_a_press_of_a_case_is_made_once_and_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("US_SIM_CACHE", str(tmp_path))
    file = find_pressing_path(7e-3)
    made = file.stat().st_mtime_ns
    assert read_path(file).positions[:, 2].max() == pytest.approx(7e-3)
    assert find_pressing_path(7e-3).stat().st_mtime_ns == made
