"""The beam's thickness: moments of its weights, and what they make of simple volumes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.geometry.pose import Pose
from us_sim.slicing.cutting.resampling import sample_plane
from us_sim.slicing.formation.elevation import WIDTH_PER_SIGMA, Elevation
from us_sim.slicing.formation.image_formation import ImageFormation
from us_sim.slicing.formation.imaging import Imaging
from us_sim.slicing.probe.beams import step_depths
from us_sim.slicing.probe.probe import LinearProbe
from us_sim.volume.volume import Volume


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
    depth = step_depths(probe())
    sigma = width / WIDTH_PER_SIGMA * np.sqrt(1 + ((depth - focus) / focus) ** 2)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose(weights @ y, 0.0, atol=1e-9 * width)
    np.testing.assert_allclose(weights @ y**2, sigma**2, rtol=1e-6)


def test_many_planes_weigh_as_a_gaussian():
    elevation = Elevation(probe(focus=0.02), Imaging(elevation_planes=15, elevation_width=2e-3))
    middle = elevation.weights[256]  # depth 20 mm
    expected = np.exp(-4 * np.log(2) * (elevation.offsets / 2e-3) ** 2)
    np.testing.assert_allclose(middle, expected / expected.sum(), atol=1e-3)


def test_the_beam_is_thinnest_at_its_focus():
    elevation = Elevation(probe(focus=0.01), Imaging(elevation_planes=7))
    variance = elevation.weights @ elevation.offsets**2
    assert abs(step_depths(probe())[variance.argmin()] - 0.01) < 1e-4


def volume_of(grey):
    """81 voxels of 0.25 mm across y, from -10 mm to 10 mm."""
    y = (np.arange(81) - 40) * 0.25e-3
    values = np.broadcast_to(grey(y)[None, :, None], (4, 81, 4))
    to_patient = np.diag([0.02, 0.25e-3, 0.02, 1.0])
    to_patient[:3, 3] = (-0.03, -0.01, -0.01)
    return Volume(np.ascontiguousarray(values, dtype=np.uint8), to_patient, None, {})


def averaged(volume, pose, **settings):
    formation = ImageFormation(probe(), Imaging(elevation_planes=5, **settings))
    return formation.form([sample_plane(volume, plane) for plane in formation.planes(pose)])


def test_a_volume_linear_across_the_plane_shows_its_middle():
    picture = averaged(volume_of(lambda y: 128 + 8000 * y), Pose([0, 0.002, 0]))
    assert (abs(picture.astype(int) - 144) <= 1).all()


def test_a_quadratic_volume_shows_the_variance():
    picture = averaged(volume_of(lambda y: 40 + 2.1e6 * y**2), Pose(), elevation_width=6e-3)
    depth = (np.arange(64) + 0.5) * 0.04 / 64
    variance = (6e-3 / 2.354820045) ** 2 * (1 + ((depth - 0.02) / 0.02) ** 2)
    # Trilinear samples of a parabola lie above it by its curvature times a quarter of d²(1-d)².
    np.testing.assert_allclose(picture[:, 8], 40 + 2.1e6 * variance, atol=1.2)


@pytest.mark.parametrize("planes", [2, 3, 4, 15])
def test_even_tissue_stays_even(planes):
    formation = ImageFormation(probe(), Imaging(elevation_planes=planes))
    for grey in (0, 1, 77, 255):
        images = [np.full((64, 16), grey, dtype=np.uint8)] * planes
        assert (formation.form(images) == grey).all()


def test_planes_are_parallel_and_lie_across_the_image():
    turned = Pose([0.01, 0.02, 0.03], [0.1, 0.2, 0.3, 0.9])
    planes = ImageFormation(probe(), Imaging(elevation_planes=3)).planes(turned)
    middle = probe().plane(turned)
    np.testing.assert_allclose(planes[1].origin, middle.origin, atol=1e-15)
    step = planes[2].origin - planes[1].origin
    np.testing.assert_allclose(step, planes[1].origin - planes[0].origin, atol=1e-15)
    # Two of the standard deviations at the face, √2 times the focal 2 mm / 2.355.
    np.testing.assert_allclose(
        step, turned.rotation[:, 1] * np.sqrt(2) * np.hypot(1, 0.999) * 0.849e-3, rtol=2e-3
    )
