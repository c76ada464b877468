"""Rigid sampling against scipy.ndimage, and at the volume's edges."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from us_sim.geometry.pose import Pose
from us_sim.slicing.cutting.resampling import sample_labels, sample_plane
from us_sim.slicing.probe.plane import SlicePlane
from us_sim.slicing.probe.probe import LinearProbe
from us_sim.volume.volume import Volume

MILLIMETRES = np.diag([1e-3, 1e-3, 1e-3, 1.0])


def noise(shape, seed=0):
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def along_x(start, step, columns, y=0.0, z=0.0):
    """A one-row plane along x, in voxels of one millimetre."""
    return SlicePlane(
        np.array([start, y, z]) * 1e-3, [step * 1e-3, 0, 0], [0, 0, 1e-3], columns=columns, rows=1
    )


@pytest.mark.parametrize("seed", range(4))
def test_oblique_planes_equal_scipy(seed):
    rng = np.random.default_rng(seed)
    turn = Pose(rng.uniform(-0.01, 0.01, 3), rng.normal(size=4))
    volume = Volume(noise((40, 30, 50), seed), turn.matrix @ np.diag([1e-3, 5e-4, 8e-4, 1.0]))
    middle = (volume.index_to_patient @ [20, 15, 25, 1])[:3]
    plane = LinearProbe(0.04, 0.04, 61, 47).make_plane(Pose(middle, rng.normal(size=4)))
    to_index = volume.patient_to_index
    index = plane.compute_pixel_positions() @ to_index[:3, :3].T + to_index[:3, 3]
    inside = ((index >= 0) & (index <= np.array(volume.shape) - 1)).all(axis=-1)
    expected = map_coordinates(
        volume.intensities.astype(float), np.moveaxis(index, -1, 0), order=1, mode="nearest"
    )
    image = sample_plane(volume, plane)
    assert inside.sum() > 300
    assert np.abs(image - np.floor(expected + 0.5))[inside].max() <= 1
    beyond = ((index < -0.51) | (index > np.array(volume.shape) - 0.49)).any(axis=-1)
    assert beyond.any()
    assert not image[beyond].any()


def test_the_outer_half_voxel_keeps_the_value_and_beyond_is_zero():
    volume = Volume(np.full((4, 2, 2), 7, np.uint8), MILLIMETRES)
    image = sample_plane(volume, along_x(-0.6, 0.1, 48))
    positions = -0.6 + 0.1 * np.arange(48)
    expected = np.where((positions > -0.501) & (positions < 3.501), 7, 0)
    np.testing.assert_array_equal(image[0], expected)


def test_labels_are_those_of_the_nearest_voxel():
    labels = np.broadcast_to(np.array([3, 1, 200], np.uint8)[:, None, None], (3, 2, 2))
    volume = Volume(np.zeros((3, 2, 2), np.uint8), MILLIMETRES, labels)
    image = sample_labels(volume, along_x(-0.72, 0.4, 10))
    np.testing.assert_array_equal(image[0], [0, 3, 3, 3, 1, 1, 200, 200, 200, 0])
