"""The upper arm: anatomy, textures and speckle against their laws, and equal bytes every time."""

import numpy as np
import pytest
from scipy import stats

from us_sim.errors import VolumeError
from us_sim.volume.phantom.phantom import make_upper_arm
from us_sim.volume.phantom.upper_arm import (
    UPPER_ARM_BLOCK,
    UPPER_ARM_LABELS,
    PointSpread,
    UpperArm,
    compute_envelope,
)
from us_sim.volume.volume import Volume

COARSE = 0.8e-3


@pytest.fixture(scope="module")
def arm() -> Volume:
    return make_upper_arm(seed=1, voxel_size=COARSE)


@pytest.fixture(scope="module")
def section():
    x, z = np.arange(-36e-3, 36e-3, 0.1e-3), np.arange(0.05e-3, 54e-3, 0.1e-3)
    return UpperArm(seed=1).cut_section(x, 0.0, z)


def _centre(section, label):
    i, k = np.nonzero(section.labels == UPPER_ARM_LABELS[label])
    return section.x[i].mean(), section.z[k].mean()


def test_the_volume_covers_the_block_with_the_skin_at_z_0(arm):
    assert arm.extent[0][2] == pytest.approx(0.0, abs=1e-12)
    assert (arm.extent[0] <= UPPER_ARM_BLOCK[0] + 1e-9).all()
    assert (abs(arm.extent[1] - UPPER_ARM_BLOCK[1] - COARSE / 2) <= COARSE / 2 + 1e-9).all()
    np.testing.assert_allclose(np.diag(arm.index_to_patient)[:3], COARSE)
    assert arm.label_names == {n: name for name, n in UPPER_ARM_LABELS.items()}
    assert set(np.unique(arm.labels)) == set(arm.label_names)
    assert (arm.labels[:, :, 0] == UPPER_ARM_LABELS["skin"]).all()


def test_structures_lie_and_measure_as_in_an_arm(section):
    area = {
        name: 0.1e-3**2 * np.count_nonzero(section.labels == number)
        for name, number in UPPER_ARM_LABELS.items()
    }
    # Ellipses of 4.5 × 4.5, 7 × 5.5 and 4.8 × 3.8 mm, each within its 4 % of size.
    assert area["artery"] == pytest.approx(np.pi / 4 * 4.5e-3**2, rel=0.1)
    assert area["vein"] == pytest.approx(np.pi / 4 * 7e-3 * 5.5e-3, rel=0.1)
    assert area["nerve"] == pytest.approx(np.pi / 4 * 4.8e-3 * 3.8e-3, rel=0.1)
    assert area["bone"] == pytest.approx(np.pi / 4 * 21e-3 * 19.6e-3, rel=0.12)
    assert area["skin"] / 72e-3 == pytest.approx(1.8e-3, abs=0.15e-3)
    assert area["fat"] / 72e-3 == pytest.approx(5.2e-3, abs=0.8e-3)
    artery, vein = _centre(section, "artery"), _centre(section, "vein")
    assert artery == pytest.approx((-6e-3, 15e-3), abs=1.5e-3)
    assert vein[0] - artery[0] == pytest.approx(8e-3, abs=1e-3)
    assert vein[1] == pytest.approx(13e-3, abs=1.5e-3)
    assert _centre(section, "bone") == pytest.approx((12e-3, 38e-3), abs=1.5e-3)


@pytest.mark.parametrize("seed", [0, 99])
def test_structures_of_any_seed_keep_apart(seed):
    arm = UpperArm(seed)
    x, z = np.arange(-20e-3, 25e-3, 0.1e-3), np.arange(5e-3, 50e-3, 0.1e-3)
    for y in (-0.03, 0.0, 0.03):
        walls = [
            t.compute_distances(x, y, z) for t in (arm.artery, arm.vein, arm.nerve, arm.humerus)
        ]
        nearest = np.sort(walls, axis=0)
        assert (nearest[0] + nearest[1]).min() > 0.2e-3


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bytes_and_another_one_moves_and_redraws(arm):
    again, other = (make_upper_arm(seed=seed, voxel_size=COARSE) for seed in (1, 2))
    assert again.intensities.tobytes() == arm.intensities.tobytes()
    assert again.labels.tobytes() == arm.labels.tobytes()
    assert (other.intensities != arm.intensities).mean() > 0.5
    # By half a millimetre, not to another arm.
    assert 0 < (other.labels != arm.labels).mean() < 0.06


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"seed": -1}, "seed of a phantom: -1 is outside"),
        ({"voxel_size": 0.1e-3}, "0.0001 m is outside 0.0002 to 0.005 m"),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    with pytest.raises(VolumeError, match=message):
        make_upper_arm(**arguments)


VOXEL = 0.3e-3
SHAPE = (90, 80, 100)
DEPTH = (np.arange(SHAPE[2]) + 0.5) * VOXEL
SPREAD = PointSpread()


def _random() -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(7))


def test_speckle_is_rayleigh_and_keeps_the_power_of_the_scatterers():
    scatterers = np.full(SHAPE, 0.02, dtype=np.float32)
    envelope = compute_envelope(scatterers, 0 * scatterers, VOXEL, DEPTH, SPREAD, _random())
    # Without the edges that the spread reaches.
    reach = np.ceil(np.array(SPREAD.compute_reach(DEPTH)) / VOXEL).astype(int)
    even = envelope[tuple(slice(r, n - r) for r, n in zip(reach, SHAPE, strict=True))]
    assert np.sqrt((even.astype(float) ** 2).mean()) == pytest.approx(0.02, rel=0.02)
    # Every fifth to eighth voxel, beyond the point spread's width: samples are independent.
    samples = even[::5, ::8, ::4].ravel()
    test = stats.kstest(samples, stats.rayleigh(scale=0.02 / np.sqrt(2)).cdf)
    assert len(samples) > 2000
    assert test.pvalue > 0.01
    assert test.statistic < 0.03


def test_speckle_correlates_as_the_point_spread_says():
    # Voxels of 0.15 mm resolve the point spread; so do the default ones, but for its axial width.
    step = 0.15e-3
    depth = SPREAD.focus + (np.arange(60) - 30) * step
    scatterers = np.ones((120, 100, 60), np.float32)
    power = compute_envelope(scatterers, 0 * scatterers, step, depth, SPREAD, _random())[
        20:-20, 20:-20
    ]
    power = power.astype(float) ** 2
    power -= power.mean()

    def correlation(axis: int, lag: int) -> float:
        first = np.take(power, np.arange(power.shape[axis] - lag), axis)
        return float((first * np.take(power, np.arange(lag, power.shape[axis]), axis)).mean())

    # Power correlates as the square of the field, whose correlation is √2 as wide as the point
    # spread: so exp(-lag² / 2σ²) with the σ of the point spread.
    for axis, width, lag in (
        (0, SPREAD.lateral, 2),
        (1, SPREAD.elevational, 4),
        (2, SPREAD.axial, 1),
    ):
        sigma = width / np.sqrt(8 * np.log(2))
        expected = np.exp(-((lag * step) ** 2) / (2 * sigma**2))
        assert correlation(axis, lag) / power.var() == pytest.approx(expected, abs=0.05)
