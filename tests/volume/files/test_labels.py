"""Labels of other programs: names, colours, layers, grids; and what is no labels."""

from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.errors import VolumeError
from us_sim.volume.cases.settings import RESERVED
from us_sim.volume.files.labels import read_labels, resample_labels
from us_sim.volume.files.readers import open_image
from us_sim.volume.files.writing import write_labels
from us_sim.volume.volume import Volume

SHAPE = (8, 7, 6)
STEPS = (0.5e-3, 1e-3, 2e-3)


def placed(turn=0.0, mirrored=False):
    c, s = np.cos(turn), np.sin(turn)
    affine = np.eye(4)
    axes = np.array([[c, -s, 0], [s, c, 0], [0, 0, -1.0 if mirrored else 1.0]])
    affine[:3, :3] = axes * STEPS
    affine[:3, 3] = (0.01, -0.02, 0.1)
    return affine


VOLUME = Volume(np.zeros(SHAPE, np.uint8), placed(0.4))


def image_of(array, affine=VOLUME.index_to_patient):
    """An image of (i, j, k) or (i, j, k, layer) values there, in millimetres."""
    axes = (2, 1, 0) if array.ndim == 3 else (2, 1, 0, 3)
    image = sitk.GetImageFromArray(np.ascontiguousarray(array.transpose(axes)), array.ndim == 4)
    matrix = affine[:3, :3] * 1e3
    spacing = np.linalg.norm(matrix, axis=0)
    image.SetSpacing(spacing.tolist())
    image.SetDirection((matrix / spacing).ravel().tolist())
    image.SetOrigin((affine[:3, 3] * 1e3).tolist())
    return image


def written(path, array, fields=None, affine=VOLUME.index_to_patient):
    image = image_of(array, affine)
    for key, value in (fields or {}).items():
        image.SetMetaData(key, value)
    sitk.WriteImage(image, str(path), True)
    return path


def segments(*entries):
    """The fields of segments: each a name, its value, its layer, and further fields."""
    fields = {"Segmentation_MasterRepresentation": "Binary labelmap"}
    for n, (name, value, layer, *more) in enumerate(entries):
        fields |= {f"Segment{n}_ID": f"Segment_{n}", f"Segment{n}_Name": name}
        fields |= {f"Segment{n}_LabelValue": str(value), f"Segment{n}_Layer": str(layer)}
        fields |= {f"Segment{n}_{key}": text for key, text in (more[0] if more else {}).items()}
    return fields


def block(*spans, value=1, shape=SHAPE):
    array = np.zeros(shape, np.uint8)
    array[tuple(slice(*span) for span in spans)] = value
    return array


def refused(path, word, **how):
    with pytest.raises(VolumeError, match=word) as error:
        read_labels(path, VOLUME, **how)
    assert str(error.value).startswith(str(path))


@pytest.mark.parametrize("suffix", [".seg.nrrd", ".nii.gz"])
def test_what_is_written_is_read_again(tmp_path, suffix):
    labels = block((1, 4), (2, 5), (0, 3), value=5)
    labels[5:7, 1:3, 2:4] = 7
    volume = Volume(np.zeros(SHAPE, np.uint8), placed(0.4), labels, {5: "artery", 7: "nerve"})
    write_labels(tmp_path / f"labels{suffix}", volume, {7: (0.125, 0.5, 0.25)})
    read = read_labels(tmp_path / f"labels{suffix}", volume)
    np.testing.assert_array_equal(read.labels, labels)
    if suffix.endswith(".nrrd"):
        assert read.names == {5: "artery", 7: "nerve"}
        assert read.colours == {5: (0.85, 0.15, 0.15), 7: (0.125, 0.5, 0.25)}
    else:
        assert read.names == {5: "structure 5", 7: "structure 7"}


def test_segments_in_layers_that_overlap_are_the_last_ones_and_that_is_said(tmp_path):
    over = block((2, 6), (0, 4), (0, 4), value=3)
    layers = np.stack([block((0, 4), (0, 4), (0, 4)), over], axis=-1)
    layers[6, 6, 5, 0] = 2
    fields = segments(
        ("artery", 1, 0, {"Color": "1 0 0"}), ("vessel wall", 3, 1), ("bone", 2, 0), ("nerve", 4, 0)
    )
    read = read_labels(written(tmp_path / "a.seg.nrrd", layers, fields), VOLUME)
    assert read.names == {1: "artery", 2: "bone", 3: "vessel wall"}
    assert read.voxels == {"artery": 32, "vessel wall": 64, "bone": 1}
    assert read.colours[1] == (1.0, 0.0, 0.0)
    assert any("overlap in 32 voxels" in said for said in read.remarks)
    assert any("nerve: no voxel" in said for said in read.remarks)
    # Of old 3D Slicer: a layer each, and the value 1.
    fields = {"Segment0_Name": "vein", "Segment1_Name": "Bone"}
    read = read_labels(
        written(tmp_path / "old.seg.nrrd", (layers > 0).astype(np.uint8), fields), VOLUME
    )
    assert read.names == {1: "vein", 2: "bone"}
    assert (read.labels[0, 0, 0], read.labels[5, 0, 0]) == (1, 2)


def shifted(*voxels):
    matrix = np.eye(4)
    matrix[:3, 3] = voxels
    return matrix


def test_a_cropped_file_is_put_where_it_belongs_and_what_is_outside_is_told(tmp_path):
    path, part = tmp_path / "part.seg.nrrd", np.ones((3, 2, 2), np.uint8)
    fields = segments(("vein", 1, 0)) | {"Segmentation_ReferenceImageExtentOffset": "2 1 3"}
    affine = VOLUME.index_to_patient @ shifted(2, 1, 3)
    read = read_labels(written(path, part, fields, affine), VOLUME)
    np.testing.assert_array_equal(np.argwhere(read.labels).min(axis=0), [2, 1, 3])
    assert read.voxels == {"vein": 12}
    affine = affine @ shifted(0, 0, 2)
    read = read_labels(written(path, part, fields, affine), VOLUME)
    assert "6 of 12 labelled voxels lie outside" in read.remarks[0]


@given(
    order=st.permutations(range(3)),
    signs=st.tuples(*[st.sampled_from((-1, 1))] * 3),
    shift=st.tuples(*[st.integers(-2, 4)] * 3),
    seed=st.integers(0, 2**16),
)
@settings(max_examples=30, deadline=None)
def test_every_labelled_voxel_keeps_its_place_in_the_patient(order, signs, shift, seed):
    labels = np.random.default_rng(seed).integers(0, 4, (3, 4, 5)).astype(np.uint8)
    turn = np.zeros((4, 4))
    turn[order, range(3)] = signs
    turn[:3, 3], turn[3, 3] = shift, 1.0
    labels[1, 2, 2] = 2
    affine = VOLUME.index_to_patient @ turn
    try:
        made, _ = resample_labels(
            Path("labels.nrrd"), labels, affine, (6, 6, 6), VOLUME.index_to_patient
        )
    except VolumeError:
        made = np.zeros((6, 6, 6), np.uint8)
    expected = np.zeros((6, 6, 6), np.uint8)
    for index in np.ndindex(labels.shape):
        at = np.rint(turn @ [*index, 1.0])[:3].astype(int)
        if (at >= 0).all() and (at < 6).all():
            expected[tuple(at)] = labels[index]
    np.testing.assert_array_equal(made, expected)


def test_another_grid_is_resampled_as_itk_does(tmp_path):
    affine = placed(0.4) @ np.diag([0.8, 0.8, 0.8, 1.0])
    array = block((1, 7), (1, 6), (1, 5), value=9).astype(np.int16) * 1000
    path = written(tmp_path / "fine.nrrd", array, None, affine)
    read = read_labels(path, VOLUME)
    reference = sitk.Resample(
        image_of(array, affine), image_of(VOLUME.intensities), interpolator=sitk.sitkNearestNeighbor
    )
    np.testing.assert_array_equal((read.labels > 0) * 9000, sitk.GetArrayFromImage(reference).T)
    assert any("resampled" in remark for remark in read.remarks)
    assert any("numbered anew" in remark for remark in read.remarks)  # labels beyond 255


TWO_BLOCKS = block((0, 2), (0, 2), (0, 2)) + block((3, 5), (3, 5), (3, 5), value=2)


def test_names_that_are_no_anatomy_are_not_kept_and_one_of_a_case_gets_a_number(tmp_path):
    fields = segments(("Mueller_Hans 12.03.1961", 1, 0), ("Portal-Vein_2", 2, 0))
    path = written(tmp_path / "a.seg.nrrd", TWO_BLOCKS, fields)
    read = read_labels(path, VOLUME)
    assert read.names == {1: "structure 1", 2: "portal vein 2"}
    assert "Mueller" not in " ".join(read.remarks)
    assert read_labels(path, VOLUME, names={1: "cyst"}).names[1] == "cyst"
    fields = segments(("tissue", 1, 0), ("vein", 2, 0))
    path = written(tmp_path / "b.seg.nrrd", TWO_BLOCKS, fields)
    assert read_labels(path, VOLUME, taken=RESERVED).names == {1: "tissue 2", 2: "vein"}
    assert read_labels(path, VOLUME, taken=RESERVED, names={1: "tissue"}).names[1] == "tissue"


ONES = np.ones(SHAPE, np.uint8)
GRADIENT = np.arange(np.prod(SHAPE), dtype=np.int16).reshape(SHAPE)


@pytest.mark.parametrize(
    ("name", "array", "fields", "word"),
    [
        ("a.nrrd", np.zeros(SHAPE, np.uint8), {}, "none of its voxels has a label"),
        ("a.mha", GRADIENT + 1, {}, "336 different values"),
        ("a.mha", GRADIENT / np.float32(3), {}, "fractions"),
        ("a.nrrd", np.ones((*SHAPE, 2), np.uint8), {}, "2 numbers per voxel"),
        ("a.seg.nrrd", ONES, segments(("vein", 1, 4)), "layer 4 of 1"),
        ("a.seg.nrrd", ONES, {"Segmentation_MasterRepresentation": "Fractional"}, "Fractional"),
    ],
)
def test_what_is_no_labels_is_refused(tmp_path, name, array, fields, word):
    refused(written(tmp_path / name, array, fields), word)


def test_labels_of_another_place_are_refused(tmp_path):
    away = VOLUME.index_to_patient @ shifted(100, 0, 0)
    refused(written(tmp_path / "a.nrrd", ONES, None, away), "wholly outside")


def test_real_segmentations_of_slicer_that_overlap_are_layers(shared_file):
    folder = shared_file("foreign-files")
    like = open_image(folder / "Segmentation.seg.nrrd")
    volume = Volume(np.zeros(like.shape, np.uint8), like.placement())
    read = read_labels(folder / "SegmentationOverlapping.seg.nrrd", volume)
    columns = {f"{part} vertebral column" for part in ("cervical", "thoracic", "lumbar")}
    assert {"ribs", "right lung", *columns} <= set(read.names.values())
