"""The middle of tubes that are known, and why other shapes have none."""

import numpy as np
import pytest
from tubes import RADIUS, SIDES, around, grid

from us_sim.errors import VolumeError
from us_sim.slicing.flow.centreline import centreline, resampled


def refusal(lumen, to_patient=None):
    with pytest.raises(VolumeError) as caught:
        centreline(lumen, np.eye(4) if to_patient is None else to_patient)
    return str(caught.value)


@pytest.mark.parametrize("direction", [(0, 1, 0), (0.3, 1, -0.2), (0.2, -1, 0.3)])
def test_it_lies_in_the_middle_of_a_straight_tube(direction):
    places, to_patient = grid()
    middle = np.array([0.0, 0.0, 0.5 * SIDES[2]])
    line = centreline(around(places, middle, direction), to_patient)
    unit = np.array(direction) / np.linalg.norm(direction)
    offset = line.points - middle
    across = np.linalg.norm(offset - np.outer(offset @ unit, unit), axis=1)
    assert across[3:-3].max() < 0.1 * RADIUS  # the ends are cut obliquely
    assert across.max() < 0.4 * RADIUS
    assert np.ptp(offset @ unit) > 0.7 * SIDES[1]
    assert line.width == pytest.approx(2 * RADIUS, rel=0.1)


def test_it_follows_a_bend():
    """A quarter of a ring of radius 15 mm, and 2.5 mm thick."""
    places, to_patient = grid(sides=(40e-3, 40e-3, 10e-3))
    x, y, z = np.moveaxis(places - [-20e-3, -20e-3, 5e-3], -1, 0)
    lumen = np.hypot(np.hypot(x, y) - 15e-3, z) < 2.5e-3
    points = centreline(lumen, to_patient).points - [-20e-3, -20e-3, 5e-3]
    assert np.abs(np.hypot(points[:, 0], points[:, 1]) - 15e-3).max() < 0.5e-3
    angles = np.arctan2(points[:, 1], points[:, 0])
    assert np.ptp(angles) > np.radians(65)


def test_a_lumen_of_very_many_voxels_is_thinned():
    lumen = np.zeros((45, 200, 45), bool)
    lumen[2:-2, :, 2:-2] = True
    points = centreline(lumen, np.eye(4)).points
    assert np.abs(points[3:-3, [0, 2]] - 22.0).max() < 1.0


def test_shapes_that_are_no_tubes_are_refused_with_the_reason():
    assert refusal(np.zeros((5, 5, 5), bool)) == "is nowhere in the volume"
    places, to_patient = grid()
    ball = np.linalg.norm(places - [0, 0, 0.01], axis=-1) < 5e-3
    assert refusal(ball, to_patient).startswith("is too short for a tube: 1")
    x, y, z = np.moveaxis(places, -1, 0)
    stem = around(places, (0, 0, 0.01), (0, 1, 0), 2e-3) & (y < 0)
    fork = stem | (np.hypot(np.abs(x) - 0.4 * y, z - 0.01) < 2e-3) & (y >= 0)
    assert refusal(fork, to_patient).startswith("branches near (")
    apart = around(places, (0, 0, 0.01), (0, 1, 0), 2e-3) & (np.abs(y) > 3e-3)
    assert refusal(apart, to_patient) == "is in 2 pieces"


def test_resampling_keeps_a_straight_line_straight_and_its_ends():
    line = np.linspace([0.0, 0, 0], [0.0, 1, 2], 7)
    smooth = resampled(line, 0.1, smoothing=0.3)
    assert np.allclose(smooth[[0, -1]], line[[0, -1]])
    assert np.allclose(np.cross(smooth, [0.0, 1, 2]), 0.0)
    steps = np.linalg.norm(np.diff(smooth, axis=0), axis=1)
    assert np.allclose(steps, steps[0])
