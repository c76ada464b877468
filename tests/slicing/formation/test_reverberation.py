"""Lines without contact: decibels lost, bands a lens apart, nothing of the tissue."""

import functools

import numpy as np
import pytest

from us_sim.slicing.formation.imaging import Imaging
from us_sim.slicing.formation.reverberation import BAND_SPACING, Reverberation
from us_sim.slicing.probe.fan_probe import ConvexProbe
from us_sim.slicing.probe.probe import LinearProbe

PROBE = LinearProbe(aperture=0.04, depth=0.04, columns=200, rows=400, lines=100)
TISSUE = np.random.Generator(np.random.PCG64(1)).integers(0, 256, (400, 200), dtype=np.uint8)


@functools.cache
def quiet():
    return Reverberation(PROBE, Imaging(contact=True, reverberation=-60.0))


@functools.cache
def air():
    return Reverberation(PROBE, Imaging(contact=True))


def coupling(value):
    return np.full(100, value, dtype=np.float32)


def test_full_contact_leaves_the_image_as_it_is():
    assert air().shown(TISSUE, coupling(1.0)) is TISSUE


@pytest.mark.parametrize(("share", "decibels"), [(0.5, 6.02), (0.1, 20.0)])
def test_a_badly_coupled_line_is_dimmer_by_decibels_at_every_depth(share, decibels):
    expected = np.maximum(TISSUE.astype(int) - round(4.25 * decibels), 0)
    np.testing.assert_array_equal(quiet().shown(TISSUE, coupling(share)), expected)


def test_air_shows_no_tissue():
    shown = air().shown(TISSUE, coupling(0.0))
    np.testing.assert_array_equal(shown, air().shown(np.zeros_like(TISSUE), coupling(0.0)))
    np.testing.assert_array_equal(shown, air().shown(TISSUE, coupling(0.0)))  # every frame
    assert (shown[-100:] == 0).all()


def test_bands_are_a_lens_apart_and_each_weaker_by_as_much():
    mean = air().shown(TISSUE, coupling(0.0)).mean(axis=1)
    spacing = 0.04 / 400
    depths = (np.arange(400) + 0.5) * spacing
    bands = [i for i in range(1, 120) if mean[i - 1] < mean[i] >= mean[i + 1]]
    assert len(bands) >= 6
    np.testing.assert_allclose(
        depths[bands[:6]], (np.arange(6) + 0.5) * BAND_SPACING, atol=1.5 * spacing
    )
    np.testing.assert_allclose(np.diff(mean[bands[:6]]), -4.25 * 5.0, atol=3.0)
    assert mean[bands[0]] == pytest.approx(255 - 4.25 * 10, abs=3.0)  # the setting's -10 dB


def test_the_first_band_is_as_strong_as_was_set():
    weaker = Reverberation(PROBE, Imaging(contact=True, reverberation=-30.0))
    difference = air().shown(TISSUE, coupling(0.0)).astype(int) - weaker.shown(
        TISSUE, coupling(0.0)
    )
    np.testing.assert_allclose(difference[:20], 85, atol=1)


@pytest.mark.parametrize(("row", "aperture"), [(10, 1.5e-3), (100, 5e-3), (380, 0.04 / 3)])
def test_a_shadow_is_as_soft_as_the_aperture_is_wide(row, aperture):
    half = (np.arange(100) < 50).astype(np.float32)  # the face's middle is the edge
    strong = np.full_like(TISSUE, 200)
    shown = quiet().shown(strong, half)[row].astype(int)
    x = (np.arange(200) - 99.5) * 0.2e-3  # m from the edge
    margin = 0.5 * aperture + 0.6e-3  # a step of depth, and a line
    assert (shown[x < -margin] == 200).all()
    assert (shown[x > margin] == 0).all()
    # Half of the aperture hears half the amplitude both ways; what it is in between is linear.
    partly = np.abs(x) < 0.5 * aperture - 0.6e-3
    share = 0.5 - x[partly] / aperture
    np.testing.assert_allclose(10 ** ((shown[partly] - 200) / 4.25 / 40), share, atol=0.06)


def test_a_fan_stays_black_beside_its_beams_and_its_bands_follow_the_face():
    probe = ConvexProbe(radius=0.05, opening_angle=1.0, depth=0.05, columns=300, rows=300)
    air = Reverberation(probe, Imaging(contact=True))
    shown = air.shown(np.zeros((300, 300), np.uint8), np.zeros(probe.lines, np.float32))
    line, way = probe.pixel_beams
    assert (shown[np.isnan(line)] == 0).all()
    bright = shown > 180
    assert bright[np.nan_to_num(line) > 150].any()
    assert bright[np.isfinite(line) & (line < 40)].any()
    off = np.abs(way[bright] / BAND_SPACING % 1.0 - 0.5) * BAND_SPACING
    assert off.max() < 0.5e-3
