"""DICOM segmentations as labels: masks of one bit, fractions, label maps, and a real one."""

import numpy as np
import pydicom
import pytest
from made_dicom import LIVER, SEGMENTED, VEIN, segmentation
from pydicom.data import get_testdata_file

from us_sim.errors import VolumeError
from us_sim.volume.deidentification.importing import look_at
from us_sim.volume.deidentification.settings import ImportSettings
from us_sim.volume.files.dicom.header import open_dicom
from us_sim.volume.files.dicom.pixels import image_format, stored_frames
from us_sim.volume.files.labels import read_labels
from us_sim.volume.volume import Volume

VOLUME = Volume(np.zeros(LIVER.shape, np.uint8), SEGMENTED)


@pytest.mark.parametrize("kind", ["BINARY", "FRACTIONAL", "LABELMAP"])
def test_segments_are_labels_with_the_names_of_their_codes(tmp_path, kind):
    read = read_labels(segmentation(tmp_path / "a.dcm", kind), VOLUME)
    np.testing.assert_array_equal(read.labels, np.where(VEIN, 2, LIVER))
    assert read.names == {1: "left kidney", 2: "portal vein"}
    assert "Doe" not in f"{read.names} {read.remarks}"
    red, green, blue = read.colours[2]
    assert red > 0.6 > 0.4 > max(green, blue)
    overlap = any("overlap in 1 voxel," in remark for remark in read.remarks)
    assert overlap == (kind != "LABELMAP")


def test_a_real_segmentation_has_the_voxels_that_pydicom_reads():
    path = get_testdata_file("liver_1frame.dcm")
    file = open_dicom(path)
    (mask,) = stored_frames(file, image_format(file), [0])
    np.testing.assert_array_equal(mask, pydicom.dcmread(path).pixel_array)
    assert mask.any()


def test_a_segmentation_is_no_volume_and_a_volume_no_segmentation(tmp_path):
    path = segmentation(tmp_path / "a.dcm")
    with pytest.raises(VolumeError, match=r"us-sim segment CASE --labels a\.dcm"):
        look_at([path], None, ImportSettings())
    with pytest.raises(VolumeError, match="without labels"):
        read_labels(get_testdata_file("MR_small.dcm"), VOLUME)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda made: made.SegmentSequence.clear(), "does not describe"),
        (lambda made: made.SharedFunctionalGroupsSequence.clear(), "where its images lie"),
    ],
)
def test_damaged_segmentations_are_refused(tmp_path, damage, message):
    made = pydicom.dcmread(segmentation(tmp_path / "a.dcm"))
    damage(made)
    made.save_as(tmp_path / "b.dcm")
    with pytest.raises(VolumeError, match=message):
        read_labels(tmp_path / "b.dcm", VOLUME)
