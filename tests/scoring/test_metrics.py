"""Metrics of scans whose values can be told by hand."""

import numpy as np
import pytest

from us_sim.errors import ScoreError
from us_sim.scoring.metrics import Force, Scan, Tally, VesselSection
from us_sim.scoring.motion import Motion
from us_sim.scoring.settings import ScoreSettings


def table(scan, settings=None):
    metrics = Tally(settings).add_scan(scan).list_metrics()
    return {(each.name, each.structure or "Probe"): each.value for each in metrics}


def circle(seconds=4.0, radius=0.03, count=4001):
    """Once round, always facing inwards: v = 2πr/T."""
    turn = np.linspace(0, 2 * np.pi, count)
    zero = 0 * turn
    positions = radius * np.stack([np.cos(turn), np.sin(turn), zero], axis=1)
    orientations = np.stack([zero, zero, np.sin(turn / 2), np.cos(turn / 2)], axis=1)
    return Motion(seconds * turn / (2 * np.pi), positions, orientations)


def test_a_round_of_a_circle():
    found = table(Scan(circle()))
    speed = 2 * np.pi * 30 / 4
    expected = {
        "Elapsed Time": 4.0,
        "Path Length": 2 * np.pi * 30,
        "Rotation Total": 360.0,
        "Average Velocity": speed,
        "Peak Velocity": speed,
    }
    assert found.keys() == {(name, "Probe") for name in expected}
    for name, value in expected.items():
        assert found[name, "Probe"] == pytest.approx(value, rel=2e-3), name


def test_a_probe_that_never_moved_has_no_speed():
    piece = Scan(circle(), since=circle().times[-1])  # nothing is new in it
    assert {metric.value for metric in Tally().add_scan(piece).list_metrics()} == {0.0}


def test_a_press_of_a_triangle():
    """0 for a second, up to 20 N and down again within 4 s, 0.1 N at 1.01 s, 0 for a second."""
    times = np.linspace(0, 6, 6001)
    force = Force(times, np.interp(times, [0, 1, 3, 5, 6], [0, 0, 20, 0, 0]))
    found = table(Scan(circle(), force), ScoreSettings(force_limit="15 N"))
    assert found["Time in Contact", "Probe"] == pytest.approx(3.98, rel=1e-3)
    assert found["Mean Probe Force in Contact", "Probe"] == pytest.approx(10.05, rel=1e-3)
    assert found["Peak Probe Force", "Probe"] == 20.0
    assert found["Time above 15 N", "Probe"] == pytest.approx(1.0, rel=1e-2)
    assert force.interpolate_at(np.array([-1.0, 2.0, 7.0])) == pytest.approx(
        [np.nan, 10, np.nan], nan_ok=True
    )


def test_the_areas_of_a_vessel():
    nan = np.nan
    section = VesselSection(
        np.arange(4.0),
        1e-6 * np.array([20.0, 5.0, 1.0, 4.0]),
        1e-6 * np.array([20.0, 20.0, nan, 16.0]),
        *np.zeros((3, 4)),
    )
    found = table(Scan(circle(), sections={"vein": section}))
    assert found["Mean Area at Rest", "vein"] == pytest.approx(56 / 3)
    assert found["Smallest Area", "vein"] == pytest.approx(4.0)  # what cannot be compared is left
    assert found["Smallest Part of the Area at Rest", "vein"] == pytest.approx(25.0)


def test_a_force_without_its_times_is_refused():
    with pytest.raises(ScoreError):
        Force(np.arange(3.0), np.arange(2.0))
    with pytest.raises(ScoreError) as refused:
        ScoreSettings(force_limit=-1.0)
    assert refused.value.key == "force_limit"
