"""The delay of a force sensor from loading and unloading."""

import numpy as np
import pytest

from us_sim.errors import StiffnessError
from us_sim.tissue.identification.press_record import find_delay

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
    with pytest.raises(StiffnessError, match="has to go in and out"):
        find_delay(poses, (stamps, felt), lambda pose: -pose.position[2], 0.3)
    few = [array[:40] for array in poses]
    with pytest.raises(StiffnessError, match="too short"):
        find_delay(tuple(few), (stamps[:40], felt[:40]), lambda pose: -pose.position[2], 0.3)
