"""The estimate against images whose motion is known, and its parts against NumPy."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter, map_coordinates

from us_sim.slicing.probe.probe import ConvexProbe, LinearProbe, SectorProbe
from us_sim.slicing.settings import StrainSettings
from us_sim.slicing.strain import measure_compression
from us_sim.slicing.strain_estimate import FrameHistory, estimate_strain, track_displacement

LINEAR = LinearProbe(aperture=0.03, depth=0.04, columns=150, rows=400, lines=128, samples=400)
PROBES = (
    LINEAR,
    ConvexProbe(radius=0.04, opening_angle=0.8, depth=0.04, columns=300, rows=300, lines=128),
    SectorProbe(aperture=0.01, opening_angle=1.2, depth=0.04, columns=300, rows=300, lines=96),
)
SETTINGS = StrainSettings(search=1.5e-3)


def speckle(shape, seed=0):
    """Grey noise with grains of a few pixels."""
    noise = gaussian_filter(np.random.default_rng(seed).normal(size=shape), (1.6, 2.0))
    return np.clip(128 + 45 * noise / noise.std(), 0, 255)


def pressed(probe, strain, seed=0):
    """An image of the probe, and the one with all tissue strained so along its beams."""
    lines, distance = probe.pixel_beams.astype(float)
    beams = speckle((2 * probe.samples, probe.lines), seed)
    images = []
    for stretch in (1.0, 1.0 + strain):
        sample = distance / stretch / probe.depth * probe.samples
        image = map_coordinates(beams, [np.nan_to_num(sample), np.nan_to_num(lines)], order=3)
        image[np.isnan(lines)] = 0.0
        images.append(np.clip(np.rint(image), 0, 255).astype(np.uint8))
    return images


@pytest.mark.parametrize("probe", PROBES, ids=lambda p: type(p).__name__)
@pytest.mark.parametrize("strain", [-0.02, 0.01])
def test_an_even_strain_along_the_beams_is_found(probe, strain):
    found = estimate_strain(*pressed(probe, strain), probe, SETTINGS)
    there = np.isfinite(found.strain)
    reached = ~np.isnan(probe.pixel_beams[0])
    assert not there[~reached].any()
    depth = probe.pixel_beams[1]
    middle = there & (depth > 0.006) & (depth < 0.034)
    assert middle.sum() > 0.95 * (reached & (depth > 0.006) & (depth < 0.034)).sum()
    assert np.mean(found.strain[middle]) == pytest.approx(strain, rel=0.05, abs=2e-4)
    assert np.std(found.strain[middle]) < 0.25 * abs(strain) + 5e-4
    assert found.correlation > 0.95
    assert measure_compression(found.strain).mean == pytest.approx(strain, rel=0.15)


def test_a_stiff_layer_is_seen_between_soft_ones():
    sample = (np.arange(400) + 0.5)[:, None] * np.ones(128)
    local = np.where((sample > 160) & (sample < 240), -0.004, -0.02)
    before = np.cumsum(1.0 / (1.0 + local), axis=0)  # where tissue was that now lies here
    beams = speckle((800, 128))
    column = np.arange(128) * np.ones((400, 1))
    first, second = (map_coordinates(beams, [rows, column], order=3) for rows in (sample, before))
    probe = LinearProbe(aperture=0.03, depth=0.04, columns=128, rows=400, lines=128, samples=400)
    images = [np.clip(np.rint(each), 0, 255).astype(np.uint8) for each in (first, second)]
    found = estimate_strain(*images, probe, StrainSettings(search=1.5e-3, fit=4e-3)).strain
    assert np.nanmean(found[185:215]) == pytest.approx(-0.004, abs=1.5e-3)
    for soft in (found[60:130], found[280:350]):
        assert np.nanmean(soft) == pytest.approx(-0.02, abs=2e-3)


@settings(max_examples=10, deadline=None)
@given(st.floats(-4.5, 4.5), st.integers(0, 1000))
def test_a_shift_of_all_is_found_to_a_fraction_of_a_sample(shift, seed):
    beams = speckle((240, 40), seed)
    rows, columns = np.meshgrid(np.arange(20, 220.0), np.arange(40.0), indexing="ij")
    first = map_coordinates(beams, [rows, columns], order=3)
    second = map_coordinates(beams, [rows - shift, columns], order=3)
    moved, correlation = track_displacement(first, second, window=(31, 9), search=6)
    whole = correlation > 0.0
    assert whole.mean() > 0.7
    np.testing.assert_allclose(np.median(moved[whole]), shift, atol=0.02)
    assert np.percentile(np.abs(moved[whole] - shift), 95) < 0.1
    assert correlation[whole].min() > 0.9


def test_without_echoes_or_without_likeness_there_is_no_strain():
    black = np.zeros((400, 150), np.uint8)
    found = estimate_strain(black, black, LINEAR, SETTINGS)
    assert np.isnan(found.strain).all()
    assert found.correlation == 0.0
    one, other = (pressed(LINEAR, 0.0, seed)[0] for seed in (1, 2))
    found = estimate_strain(one, other, LINEAR, SETTINGS)
    assert np.isfinite(found.strain).mean() < 0.2
    assert found.correlation < 0.7
    assert measure_compression(np.full((3, 3), np.nan)) == (0.0, 0.0)


def test_an_image_is_compared_with_the_one_so_many_before_of_the_same_probe_and_mesh():
    earlier = FrameHistory(lambda frame: frame.pixels)

    def before(number, probe="linear", mesh=None):
        frame = SimpleNamespace(number=number, probe=probe, mesh=mesh, pixels=10 * number)
        return earlier.get_before(frame, 2)

    assert [before(number) for number in (0, 1, 2, 3, 3)] == [None, None, 0, 10, 10]
    assert [before(number) for number in (6, 7, 8)] == [None, None, 60]  # 4 and 5 were missed
    assert [before(number, mesh="another") for number in (9, 10, 11)] == [None, None, 90]
    assert before(12, probe="another", mesh="another") is None
