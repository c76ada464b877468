"""Points as wide and long as was asked, and the thickness of the beam."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.geometry.pose import Pose
from us_sim.slicing.formation.image_formation import WIDTH_PER_SIGMA, Elevation, ImageFormation
from us_sim.slicing.formation.resolution import Resolution
from us_sim.slicing.probe.beams import compute_step_depths
from us_sim.slicing.probe.probe import ConvexProbe, LinearProbe, SectorProbe
from us_sim.slicing.settings import Imaging

POINT = 0.6e-3  # m, full width at half maximum, so that pixels show it whole
LINEAR = LinearProbe(aperture=0.04, depth=0.06, columns=400, rows=600, focus=0.02)
CONVEX = ConvexProbe(
    radius=0.05, opening_angle=np.radians(60), depth=0.1, columns=900, rows=800, focus=0.04
)
SECTOR = SectorProbe(
    aperture=0.02, opening_angle=np.radians(80), depth=0.1, columns=900, rows=700, focus=0.06
)


def picture_of_point(probe, line, depth, imaging):
    """The picture of a point POINT wide on a line (0 to 1 of all) at a depth, and where it is."""
    number = line * (probe.lines - 1)
    start = [np.interp(number, np.arange(probe.lines), s) for s in probe.beam_starts.T]
    direction = np.array(
        [np.interp(number, np.arange(probe.lines), d) for d in probe.beam_directions.T]
    )
    direction /= np.linalg.norm(direction)
    at = start + depth * direction
    column, row = np.meshgrid(np.arange(probe.columns), np.arange(probe.rows))
    x = probe.image_to_probe[0, 0] * column + probe.image_to_probe[0, 3] - at[0]
    z = probe.image_to_probe[2, 1] * row + probe.image_to_probe[2, 3] - at[1]
    amplitude = np.exp(-4 * np.log(2) * (x * x + z * z) / POINT**2)
    level = np.round(255 * (1 + 20 * np.log10(np.maximum(amplitude, 1e-9)) / 60))
    image = np.clip(level, 0, 255).astype(np.uint8)
    return Resolution(probe, imaging).spread_echoes(image), at, direction


def width_along(probe, picture, at, direction, reach=8e-3):
    """Full width (m) at half the amplitude, 6.02 dB below the peak, through ``at``."""
    way = np.linspace(-reach, reach, 1601)
    inverse = np.linalg.inv(probe.image_to_probe)
    points = np.zeros((4, len(way)))
    points[0], points[2], points[3] = at[0] + way * direction[0], at[1] + way * direction[1], 1.0
    column, row = (inverse @ points)[:2]
    c0, r0 = np.floor(column).astype(int), np.floor(row).astype(int)
    c0, r0 = np.clip(c0, 0, probe.columns - 2), np.clip(r0, 0, probe.rows - 2)
    u, v = column - c0, row - r0
    level = (1 - v) * ((1 - u) * picture[r0, c0] + u * picture[r0, c0 + 1]) + v * (
        (1 - u) * picture[r0 + 1, c0] + u * picture[r0 + 1, c0 + 1]
    )
    # A parabola through the top 15 dB: what a Gaussian is in decibels, free of grey steps.
    near = level > level.max() - 15 * 4.25
    a, _, _ = np.polyfit(way[near] / reach, level[near], 2)
    return 2 * reach * np.sqrt(20 * np.log10(2) * 4.25 / -a)


@pytest.mark.parametrize("probe", [LINEAR, CONVEX, SECTOR], ids=["linear", "convex", "sector"])
@pytest.mark.parametrize(("part", "line"), [(0.35, 0.25), (0.7, 0.5), (1.4, 0.25)])
def test_the_lateral_width_is_as_asked_and_grows_away_from_the_focus(probe, part, line):
    depth = part * probe.focus
    asked = 1.5e-3 * np.sqrt(1 + (part - 1) ** 2)
    picture, at, along = picture_of_point(probe, line, depth, Imaging(lateral_resolution=1.5e-3))
    across = np.array([along[1], -along[0]])
    found = width_along(probe, picture, at, across)
    assert found == pytest.approx(np.hypot(asked, POINT), rel=0.03)
    # Resampling to beams and back may lengthen the point, by less than a pixel.
    assert width_along(probe, picture, at, along) < 1.1 * POINT


@pytest.mark.parametrize("probe", [LINEAR, CONVEX, SECTOR], ids=["linear", "convex", "sector"])
@pytest.mark.parametrize("depth", [0.01, 0.05])
def test_the_axial_length_is_as_asked_and_grows_a_tenth_each_centimetre(probe, depth):
    picture, at, along = picture_of_point(probe, 0.4, depth, Imaging(axial_resolution=1e-3))
    found = width_along(probe, picture, at, along)
    assert found == pytest.approx(np.hypot(1e-3 * (1 + 10 * depth), POINT), rel=0.03)


def test_a_point_loses_the_height_that_its_width_gains():
    imaging = Imaging(lateral_resolution=2e-3)
    picture, _, _ = picture_of_point(LINEAR, 0.5, 0.02, imaging)
    lost = 10 * np.log10(np.hypot(2e-3, POINT) / POINT)  # dB: the same power in both
    assert picture.max() == pytest.approx(255 - 4.25 * lost, abs=1.5)


@pytest.mark.parametrize("probe", [LINEAR, CONVEX, SECTOR], ids=["linear", "convex", "sector"])
def test_even_tissue_stays_even_to_the_edges(probe):
    imaging = Imaging(lateral_resolution=2e-3, axial_resolution=1e-3)
    picture = Resolution(probe, imaging).spread_echoes(
        np.full((probe.rows, probe.columns), 120, np.uint8)
    )
    reached = np.isfinite(probe.pixel_beams[0])
    assert (picture[reached] == 120).all()
    assert (picture[~reached] == 0).all()


def probe(**settings):
    return LinearProbe(aperture=0.04, depth=0.04, columns=16, rows=64, **settings)


@settings(max_examples=30, deadline=None)
@given(
    planes=st.sampled_from([3, 5, 7, 9, 15]),
    width=st.floats(2e-4, 0.02),
    focus=st.floats(0.008, 0.08),
)
def test_weights_have_the_moments_of_the_beam(planes, width, focus):
    elevation = Elevation(
        probe(focus=focus), Imaging(elevation_planes=planes, elevation_width=width)
    )
    weights, y = elevation.weights, elevation.offsets
    depth = compute_step_depths(probe())
    sigma = width / WIDTH_PER_SIGMA * np.sqrt(1 + ((depth - focus) / focus) ** 2)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose(weights @ y, 0.0, atol=1e-9 * width)
    np.testing.assert_allclose(weights @ y**2, sigma**2, rtol=1e-6)


def test_planes_are_parallel_and_lie_across_the_image():
    turned = Pose([0.01, 0.02, 0.03], [0.1, 0.2, 0.3, 0.9])
    planes = ImageFormation(probe(), Imaging(elevation_planes=3)).make_planes(turned)
    middle = probe().make_plane(turned)
    np.testing.assert_allclose(planes[1].origin, middle.origin, atol=1e-15)
    step = planes[2].origin - planes[1].origin
    np.testing.assert_allclose(step, planes[1].origin - planes[0].origin, atol=1e-15)
    # Two of the standard deviations at the face, √2 times the focal 2 mm / 2.355.
    np.testing.assert_allclose(
        step, turned.rotation[:, 1] * np.sqrt(2) * np.hypot(1, 0.999) * 0.849e-3, rtol=2e-3
    )
