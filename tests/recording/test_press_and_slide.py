"""The demo's path: its phases, and that the bag in the repository holds it."""

from pathlib import Path

import numpy as np
import pytest

from us_sim.errors import BagError
from us_sim.recording.path import read_path
from us_sim.recording.press_and_slide import main, press_and_slide
from us_sim.recording.reader import read_bag

BAG = Path(__file__).resolve().parents[2] / "bags/press_and_slide.mcap"


def at(seconds):
    """Number of the pose at a time, at 60 Hz."""
    return round(seconds * 60)


def test_phases():
    path = press_and_slide()
    x, y, z = path.positions.T
    assert len(path) == 600
    assert path.frame_id == "patient"
    np.testing.assert_array_equal(x, 0)
    for seconds, height in [(0, -0.01), (1, -0.01), (1.5, 0), (3.5, 0.012), (5, 0.012), (6, 0.012)]:
        assert z[at(seconds)] == pytest.approx(height, abs=1e-12)
    for seconds, height in [(7.5, 0.012), (8.7, 0), (9.2, -0.01), (9.9, -0.01)]:
        assert z[at(seconds)] == pytest.approx(height, abs=1e-12)
    # Halfway in time a minimum-jerk motion is halfway in space.
    assert z[at(2.5)] == pytest.approx(0.006, abs=1e-12)
    assert y[at(6.25)] == y.max() == pytest.approx(0.008, abs=1e-12)
    assert np.all(y[: at(5)] == 0)
    assert np.all(y[at(7.5) :] == 0)
    tilt = 2 * np.degrees(np.arctan2(path.orientations[:, 0], path.orientations[:, 3]))
    assert (tilt.min(), tilt.max()) == pytest.approx((-4, 4), abs=0.01)
    assert tilt[at(6.25)] == pytest.approx(0, abs=1e-12)
    np.testing.assert_allclose(np.linalg.norm(path.orientations, axis=1), 1, atol=1e-15)


def test_it_moves_as_smoothly_as_a_hand():
    path = press_and_slide(rate=600)
    velocity = np.diff(path.positions, axis=0) * 600
    acceleration = np.diff(velocity, axis=0) * 600
    # A minimum-jerk motion over a distance d in a time T peaks at 1.875 d/T and 5.774 d/T².
    assert np.abs(velocity).max() == pytest.approx(1.875 * 0.01 / 0.5, rel=1e-3)
    assert np.abs(acceleration).max() == pytest.approx(5.774 * 0.01 / 0.5**2, rel=1e-2)


def test_stamps_are_60_hz_from_a_fixed_epoch():
    stamps = press_and_slide().stamps
    assert stamps[0] == 1_700_000_000 * 10**9
    assert stamps[60] - stamps[0] == 10**9
    assert set(np.diff(stamps)) == {16_666_666, 16_666_667}


def test_settings_scale_it():
    path = press_and_slide(rate=30, duration=5, depth=0.02, hover=0.005)
    assert len(path) == 150
    assert path.positions[:, 2].max() == pytest.approx(0.02)
    assert path.positions[:, 2].min() == pytest.approx(-0.005)
    assert path.positions[round(30 * 1.75), 2] == pytest.approx(0.02, rel=1e-4)


@pytest.mark.parametrize(
    "settings", [{"rate": 0}, {"duration": -1}, {"depth": -0.001}, {"hover": float("nan")}]
)
def test_impossible_settings(settings):
    with pytest.raises(BagError, match="a path cannot have"):
        press_and_slide(**settings)


def test_the_bag_in_the_repository_is_this_path(tmp_path, capsys, monkeypatch):
    # It was written without ROS 2, whose installed definitions carry comments.
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    made = press_and_slide()
    kept = read_path(BAG)
    assert (kept.topic, kept.frame_id) == ("/tracker/pose", "patient")
    for array in ("stamps", "log_times"):
        np.testing.assert_array_equal(getattr(kept, array), getattr(made, array))
    # Sines and cosines of different machines may differ in their last bit.
    np.testing.assert_allclose(kept.positions, made.positions, rtol=0, atol=1e-15)
    np.testing.assert_allclose(kept.orientations, made.orientations, rtol=0, atol=1e-15)
    assert main([str(tmp_path / "again.mcap")]) == 0
    assert read_bag(tmp_path / "again.mcap").topics == read_bag(BAG).topics
    assert main([str(tmp_path / "again.mcap")]) == 1
    assert "exists already" in capsys.readouterr().err
    assert main([]) == 2
