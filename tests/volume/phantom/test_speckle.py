"""Speckle: Rayleigh statistics, the size of a speckle, interfaces, and the display's scale."""

import numpy as np
import pytest
from scipy import stats

from us_sim.volume.phantom.speckle import PointSpread, echo_envelope, log_compress

VOXEL = 0.3e-3
SHAPE = (90, 80, 100)
DEPTH = (np.arange(SHAPE[2]) + 0.5) * VOXEL
SPREAD = PointSpread()


def _random() -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(7))


@pytest.fixture(scope="module")
def even() -> np.ndarray:
    """The envelope of evenly scattering tissue, without the edges that the spread reaches."""
    scatterers = np.full(SHAPE, 0.02, dtype=np.float32)
    nothing = np.zeros(SHAPE, dtype=np.float32)
    envelope = echo_envelope(scatterers, nothing, VOXEL, DEPTH, SPREAD, _random())
    reach = np.ceil(np.array(SPREAD.reach(DEPTH)) / VOXEL).astype(int)
    inside = tuple(slice(r, n - r) for r, n in zip(reach, SHAPE, strict=True))
    return envelope[inside]


def test_mean_over_deviation_is_that_of_a_rayleigh_distribution(even):
    # sqrt(pi / (4 - pi)) = 1.913: the signal-to-noise ratio of fully developed speckle.
    assert even.mean() / even.std() == pytest.approx(np.sqrt(np.pi / (4 - np.pi)), rel=0.02)


def test_the_power_of_the_scatterers_is_kept(even):
    assert np.sqrt((even.astype(float) ** 2).mean()) == pytest.approx(0.02, rel=0.02)


def test_the_whole_distribution_is_rayleigh(even):
    # Every fifth to eighth voxel, beyond the point spread's width, so that samples are independent.
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
    power = echo_envelope(scatterers, 0 * scatterers, step, depth, SPREAD, _random())[
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


def test_the_beam_is_narrowest_at_its_focus():
    at_focus = SPREAD.widths(SPREAD.focus)
    assert at_focus == (SPREAD.lateral, SPREAD.elevational)
    assert SPREAD.widths(SPREAD.focus + SPREAD.lateral_range)[0] == pytest.approx(
        np.sqrt(2) * SPREAD.lateral
    )
    assert min(SPREAD.widths(0.0)) > SPREAD.lateral


def test_an_interface_alone_does_not_speckle():
    sheet = np.zeros((40, 40, 40), np.float32)
    sheet[:, :, 20] = 1.0
    depth = DEPTH[:40]
    envelope = echo_envelope(0 * sheet, sheet, VOXEL, depth, SPREAD, _random())[12:-12, 12:-12]
    sigma = SPREAD.axial / np.sqrt(8 * np.log(2)) / VOXEL
    profile = np.exp(-0.5 * ((np.arange(40) - 20) / sigma) ** 2)
    profile[np.abs(np.arange(40) - 20) > np.ceil(3 * sigma)] = 0.0
    profile /= profile.sum()
    np.testing.assert_allclose(envelope, np.broadcast_to(profile, envelope.shape), atol=1e-5)


def test_voxels_coarser_than_a_speckle_are_rayleigh_too():
    scatterers = np.ones((30, 30, 30), np.float32)
    depth = (np.arange(30) + 0.5) * 2e-3
    envelope = echo_envelope(scatterers, 0 * scatterers, 2e-3, depth, SPREAD, _random())
    assert envelope[2:-2, 2:-2].mean() / envelope[2:-2, 2:-2].std() == pytest.approx(
        1.913, rel=0.02
    )


def test_sixty_decibels_fill_the_grey_scale():
    levels = np.array([20.0, 0.0, -20.0, -40.0, -60.0, -80.0, -np.inf])
    grey = log_compress((10.0 ** (levels / 20.0)).astype(np.float32))
    np.testing.assert_array_equal(grey, [255, 255, 170, 85, 0, 0, 0])
    assert log_compress(np.float32([0.1]), dynamic_range=40.0)[0] == 128
