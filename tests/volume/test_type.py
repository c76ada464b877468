"""The volume type: where its voxels lie, and what it refuses."""

import dataclasses

import numpy as np
import pytest

from us_sim.errors import VolumeError
from us_sim.volume.volume import Volume

GREY = np.zeros((4, 5, 6), dtype=np.uint8)
MILLIMETRES = np.diag([1e-3, 1e-3, 1e-3, 1.0])


def test_extent_encloses_the_voxels_faces():
    matrix = np.diag([2e-3, 1e-3, -0.5e-3, 1.0])
    matrix[:3, 3] = [0.1, 0.2, 0.3]
    expected = [[0.099, 0.1995, 0.3 - 5.5 * 0.5e-3], [0.107, 0.2045, 0.30025]]
    np.testing.assert_allclose(Volume(GREY, matrix).extent, expected, atol=1e-12)


def test_arrays_are_read_only_views_and_the_callers_stay_writable():
    grey = np.arange(120, dtype=np.uint8).reshape(4, 5, 6)
    volume = Volume(grey, MILLIMETRES, labels=GREY)
    assert np.shares_memory(volume.intensities, grey)
    assert not volume.intensities.flags.writeable
    assert not volume.labels.flags.writeable
    assert grey.flags.writeable
    contiguous = Volume(np.asfortranarray(grey), MILLIMETRES).intensities
    assert contiguous.flags.c_contiguous
    np.testing.assert_array_equal(contiguous, grey)
    moved = dataclasses.replace(volume, index_to_patient=np.diag([2e-3, 2e-3, 2e-3, 1.0]))
    assert moved.patient_to_index[0, 0] == pytest.approx(500.0)  # replaced with it


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"intensities": GREY.astype(np.int16)}, "not int16"),
        ({"labels": GREY[:, :, :5]}, "must have the same shape"),
        ({"index_to_patient": np.diag([1e-3, 0.0, 1e-3, 1.0])}, "singular"),
        ({"index_to_patient": np.diag([1e-3, 1e-3, 1e-3, 2.0])}, "last row"),
    ],
)
def test_what_is_no_volume_is_refused(change, message):
    given_values = {"intensities": GREY, "index_to_patient": MILLIMETRES, **change}
    with pytest.raises(VolumeError, match=message):
        Volume(**given_values)
