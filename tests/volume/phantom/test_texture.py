"""Noise, sheets and tubes, against their laws."""

import numpy as np
import pytest

from us_sim.volume.phantom.upper_arm import SmoothNoise, Tube, sheets

BLOCK = np.array([[0.0, 0.0, 0.0], [0.1, 0.1, 0.1]])


def _noise(seed: int) -> SmoothNoise:
    return SmoothNoise(np.random.Generator(np.random.PCG64(seed)), BLOCK, (2e-3, 3e-3, 1e-3))


def test_noise_has_mean_0_and_variance_1():
    x, z = np.linspace(0, 0.1, 101), np.linspace(0, 0.1, 201)
    values = np.stack([_noise(3).plane(x, y, z) for y in np.linspace(0.0, 0.1, 21)])
    assert abs(values.mean()) < 0.02
    assert values.var() == pytest.approx(1.0, abs=0.03)


def test_noise_does_not_depend_on_where_else_it_is_sampled():
    noise = _noise(4)
    x, z = np.array([0.0213, 0.05]), np.array([0.07, 0.0712, 0.08])
    fine = noise.plane(np.array([0.01, 0.05, 0.06]), 0.033, np.array([0.0712]))
    assert noise.plane(x, 0.033, z)[1, 1] == pytest.approx(fine[1, 0], abs=1e-12)


def test_noise_is_smooth_and_goes_on_beyond_its_block():
    noise = _noise(5)
    x = np.linspace(-0.01, 0.11, 12001)
    values = noise.plane(x, 0.05, np.array([0.05]))[:, 0]
    assert np.isfinite(values).all()
    assert np.abs(np.diff(values)).max() < 0.05
    assert values[0] == pytest.approx(noise.plane(np.array([0.0]), 0.05, np.array([0.05]))[0, 0])


def test_a_line_of_noise_lies_in_the_lower_face():
    noise = _noise(6)
    x = np.linspace(0.01, 0.02, 7)
    np.testing.assert_allclose(noise.line(x, 0.02), noise.plane(x, 0.02, np.zeros(1))[:, 0])


@pytest.mark.parametrize("angle", [0.0, 0.4, np.pi / 2])
def test_a_tilted_plane_is_one_sheet_of_the_given_thickness(angle):
    step, thickness = 0.05e-3, 0.2e-3
    x, z = np.meshgrid(np.arange(100) * step, np.arange(120) * step, indexing="ij")
    across = (x - 2.5e-3) * np.sin(angle) + (z - 3e-3) * np.cos(angle)
    profile, facing = sheets(700.0 * across, (step, step), thickness)
    np.testing.assert_allclose(profile, np.exp(-0.5 * (across / thickness) ** 2), atol=1e-9)
    np.testing.assert_allclose(facing, np.cos(angle) ** 2, atol=1e-9)


def test_a_round_tube_has_the_distance_of_a_circle():
    tube = Tube((1e-3, 10e-3), (3e-3, 3e-3))
    x, z = np.linspace(-5e-3, 7e-3, 25), np.linspace(4e-3, 16.3e-3, 24)
    distance = tube.distance(x, 0.0, z)
    radius = np.hypot(x[:, None] - 1e-3, z - 10e-3)
    np.testing.assert_allclose(distance, radius - 3e-3, atol=1e-8)


def test_an_elliptical_tube_follows_its_middle():
    tube = Tube((2e-3, 13e-3), (3.5e-3, 2.75e-3), swing=(1e-3, 0.5e-3), phase=0.3)
    for y in (-0.03, 0.0, 0.02):
        middle_x, middle_z = tube.middle(y)
        x = np.array([middle_x, middle_x + 3.5e-3])
        z = np.array([middle_z - 2.75e-3, middle_z])
        distance = tube.distance(x, y, z)
        assert distance[0, 0] == pytest.approx(0.0, abs=1e-12)
        assert distance[1, 1] == pytest.approx(0.0, abs=1e-12)
        assert distance[0, 1] < -2e-3
        assert abs(middle_x - 2e-3) <= 1e-3
        assert abs(middle_z - 13e-3) <= 0.5e-3
