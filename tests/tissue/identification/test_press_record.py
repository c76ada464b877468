"""Pairing wrenches with poses: by stamps, the last of equal ones, none that is no number."""

import numpy as np
import pytest

from us_sim.errors import StiffnessError
from us_sim.tissue.identification.press_record import paired, stamped_alike, without_wrench

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
        (
            lambda felt: felt.__setitem__((7, 2), np.nan),
            "1 of 50 wrenches are not finite.*number 8",
        ),
        (lambda felt: felt.__setitem__(slice(None), 0.4), "never changes"),
    ],
)
def test_what_is_no_force_is_refused(spoil, sentence):
    felt = ramp(STAMPS)
    spoil(felt)
    with pytest.raises(StiffnessError, match=sentence):
        paired(POSES, (STAMPS, felt), tolerance=0.01)


def test_clocks_that_never_met_are_refused():
    with pytest.raises(StiffnessError, match="0 of 50 poses have a wrench within 10 ms"):
        paired(POSES, (STAMPS + 10**12, ramp(STAMPS)), tolerance=0.01)
