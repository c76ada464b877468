"""DICOM segmentations as labels: masks of one bit, fractions, label maps, and a real one."""

import numpy as np
import pydicom
import pytest
from made_dicom import header, item, write
from pydicom.data import get_testdata_file
from pydicom.pixels.utils import pack_bits

from us_sim.errors import VolumeError
from us_sim.volume.deidentification.importing import look_at
from us_sim.volume.deidentification.settings import ImportSettings
from us_sim.volume.files.dicom.grey import stored_frames
from us_sim.volume.files.dicom.header import open_dicom
from us_sim.volume.files.dicom.image_format import image_format
from us_sim.volume.files.labels import read_labels
from us_sim.volume.volume import Volume

SHAPE = (7, 5, 6)
PLACED = np.diag([0.5e-3, 0.25e-3, 2e-3, 1.0])
PLACED[:3, 3] = (0.01, -0.02, 0.03)
VOLUME = Volume(np.zeros(SHAPE, np.uint8), PLACED)
LIVER = np.zeros(SHAPE, bool)
LIVER[1:4, 1:3, 2:5] = True
VEIN = np.zeros(SHAPE, bool)
VEIN[3:6, 2:4, 0] = VEIN[3:6, 2:4, 4] = True  # of its slices three in between have no frame

SCT = {"CodingSchemeDesignator": "SCT"}


def segment(number, label, code, side=None):
    kind = item(CodeValue=code, CodeMeaning="Doe Jane", **SCT)
    if side:
        modifier = item(CodeValue=side, CodeMeaning="x", **SCT)
        kind.SegmentedPropertyTypeModifierCodeSequence = [modifier]
    made = item(SegmentNumber=number, SegmentLabel=label, SegmentAlgorithmType="MANUAL")
    made.SegmentedPropertyTypeCodeSequence = [kind]
    made.RecommendedDisplayCIELabValue = [34885, 53485, 50171]  # a red
    return made


def segmentation(path, kind="BINARY"):
    """LIVER as segment 1 and VEIN as segment 2, each slice with a voxel a frame."""
    frames, groups = [], []
    masks = {1: LIVER, 2: VEIN}
    for number, mask in masks.items() if kind != "LABELMAP" else [(0, LIVER | VEIN)]:
        for k in range(SHAPE[2]):
            if not mask[:, :, k].any():
                continue
            values = np.where(VEIN, 2, LIVER)[:, :, k] if kind == "LABELMAP" else mask[:, :, k]
            frames.append(values.T.astype(np.uint8) * (200 if kind == "FRACTIONAL" else 1))
            at = (PLACED @ [0, 0, k, 1])[:3] * 1e3
            group = item(PlanePositionSequence=[item(ImagePositionPatient=at.tolist())])
            if number:
                referenced = item(ReferencedSegmentNumber=number)
                group.SegmentIdentificationSequence = [referenced]
            groups.append(group)
    uid = "1.2.840.10008.5.1.4.1.1.66." + ("7" if kind == "LABELMAP" else "4")
    made = header(np.array(frames), uid, Modality="SEG", SegmentationType=kind)
    if kind == "BINARY":
        made.BitsAllocated = made.BitsStored = 1
        made.HighBit = 0
        made.PixelData = pack_bits(np.array(frames))
    if kind == "FRACTIONAL":
        made.MaximumFractionalValue = 255
    measures = item(PixelSpacing=[0.25, 0.5], SpacingBetweenSlices=2.0)
    along = item(ImageOrientationPatient=[1, 0, 0, 0, 1, 0])
    made.SharedFunctionalGroupsSequence = [
        item(PixelMeasuresSequence=[measures], PlaneOrientationSequence=[along])
    ]
    made.PerFrameFunctionalGroupsSequence = groups
    made.SegmentSequence = [
        segment(1, "Doe Jane", "64033007", "7771000"),
        segment(2, "portal vein", "32764006"),
    ]
    return write(path, made)


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
        (lambda made: setattr(made, "NumberOfFrames", 4), "bytes of images"),
    ],
)
def test_damaged_segmentations_are_refused(tmp_path, damage, message):
    made = pydicom.dcmread(segmentation(tmp_path / "a.dcm"))
    damage(made)
    made.save_as(tmp_path / "b.dcm")
    with pytest.raises(VolumeError, match=message):
        read_labels(tmp_path / "b.dcm", VOLUME)
