"""Volume files: hand-written MetaImage, NRRD and NIfTI, what SimpleITK writes, and real ones."""

import bz2
import gzip
import zlib

import nibabel
import numpy as np
import pytest
import SimpleITK as sitk

from us_sim.errors import VolumeError
from us_sim.volume.files.readers import (
    describe_sequence,
    open_image,
    read_placement,
    read_volume,
)
from us_sim.volume.files.stored_image import read_grey_voxels
from us_sim.volume.files.writing import write_volume

SHAPE = (4, 5, 6)
GREY = np.random.default_rng(2).integers(0, 256, SHAPE, dtype=np.uint8)


def _metaimage(path, data=None, **fields):
    """A MetaImage file of uint8 voxels (i, j, k) written field by field, i fastest."""
    header = {"ObjectType": "Image", "NDims": "3", "DimSize": "4 5 6", "ElementType": "MET_UCHAR"}
    header |= {"TransformMatrix": "1 0 0 0 1 0 0 0 1", "ElementSpacing": "1 1 1"}
    header |= {**fields, "ElementDataFile": "LOCAL"}
    text = "".join(f"{key} = {value}\n" for key, value in header.items())
    path.write_bytes(text.encode() + (GREY.tobytes(order="F") if data is None else data))
    return path


def _stored(path, voxels):
    """A file of an array (k, j, i), as SimpleITK writes it."""
    sitk.WriteImage(sitk.GetImageFromArray(voxels), str(path))
    return path


def _nifti(path, voxels, matrix_ras, unit="mm", **fields):
    """A NIfTI file placed by its sform alone."""
    image = nibabel.Nifti1Image(voxels, None)
    image.set_sform(matrix_ras, code=1)
    steps = np.linalg.norm(matrix_ras[:3, :3], axis=0)
    image.header.set_zooms((*steps, *voxels.shape[3:]))
    image.header.set_xyzt_units(unit)
    content = bytearray(image.to_bytes())
    stored = np.frombuffer(content, nibabel.nifti1.header_dtype, 1)  # as it is, and not mended
    for key, value in fields.items():
        stored[key] = value
    path.write_bytes(content)
    return path


RAW = GREY.astype("<i2") * 3
MARKED = RAW.tobytes(order="F")
SPREAD = np.floor((RAW - RAW.min()) / np.ptp(RAW) * 255.0 + 0.5).astype(np.uint8)


def _nrrd(path, data, *lines):
    """An NRRD file of int16 voxels with further lines."""
    said = {"type": "short", "dimension": "3", "sizes": "4 5 6", "encoding": "raw"}
    said |= {"endian": "little", **dict(line.split(": ", 1) for line in lines)}
    text = "".join(f"{key}: {value}\n" for key, value in said.items())
    path.write_bytes(f"NRRD0004\n{text}\n".encode() + data)
    return path


PLACED = ("space: LPS", "space directions: (0.5,0,0) (0,0.25,0) (0,0,2)", "space origin: (7,8,9)")


def refused(path, message):
    """One sentence that begins with the file."""
    with pytest.raises(VolumeError, match=message) as error:
        read_volume(path)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("suffix", [".mha", ".nrrd", ".nii.gz"])
@pytest.mark.parametrize("compressed", [False, True])
def test_an_oblique_image_lies_where_simpleitk_says(tmp_path, suffix, compressed):
    image = sitk.GetImageFromArray(GREY.T)
    turn = sitk.VersorRigid3DTransform()
    turn.SetRotation((0.3, -0.5, 0.8), 0.7)
    image.SetDirection(turn.GetMatrix())
    image.SetSpacing((0.5, 0.25, 2.0))
    image.SetOrigin((-12.5, 40.0, 7.75))
    path = tmp_path / f"oblique{suffix}"
    sitk.WriteImage(image, str(path), compressed)
    volume = read_volume(path)
    np.testing.assert_array_equal(volume.intensities, GREY)
    for index in ((0, 0, 0), (3, 0, 0), (0, 4, 0), (1, 2, 5)):
        expected = np.array(image.TransformIndexToPhysicalPoint(index)) * 1e-3
        placed = volume.index_to_patient @ [*index, 1]
        np.testing.assert_allclose(placed[:3], expected, atol=1e-8)


@pytest.mark.parametrize("dtype", [np.int8, np.uint16, np.float64])
def test_other_types_are_spread_over_the_whole_range(tmp_path, dtype):
    lowest = 0 if dtype == np.uint16 else -100
    stored = (lowest + np.array([0, 51, 102, 153, 204])).astype(dtype)
    grey = read_volume(_stored(tmp_path / "a.nrrd", np.resize(stored, (5, 5, 5)))).intensities
    # 0, 1/4, 1/2, 3/4 and 1 of 255, halves rounded up.
    np.testing.assert_array_equal(grey[:, 0, 0], [0, 64, 128, 191, 255])


def test_a_float_image_may_have_holes_and_a_vast_range(tmp_path):
    stored = np.zeros((3, 3, 3))
    stored[0, :2] = [-1.7e308, np.nan, 1.7e308], [np.inf, -np.inf, 0.0]
    path = _stored(tmp_path / "a.nrrd", stored)
    grey, _ = read_grey_voxels(open_image(path))
    np.testing.assert_array_equal(grey[:, :2, 0].T, [[0, 0, 255], [255, 0, 128]])
    assert not read_volume(_stored(path, np.full((3, 3, 3), 7, np.int16))).intensities.any()
    refused(_stored(path, np.full((3, 3, 3), np.nan)), "finite")


@pytest.mark.parametrize(
    "name",
    [
        "imfusion-liver-sweep/liver_sweep_compounded_1mm.mha",
        # With the status of a frame in its header, and with the axes of a sequence.
        "plus-spine-freehand/VolumeReconstructorTestNNMEANvolumeRef.mha",
    ],
)
def test_real_volumes_are_what_simpleitk_reads(shared_file, name):
    image = sitk.ReadImage(str(shared_file(name)))
    volume = read_volume(shared_file(name))
    if image.GetPixelID() == sitk.sitkUInt8:
        np.testing.assert_array_equal(volume.intensities, sitk.GetArrayFromImage(image).T)
    for index in ((0, 0, 0), (30, 20, 10)):
        expected = np.array(image.TransformIndexToPhysicalPoint(index)) * 1e-3
        np.testing.assert_allclose(volume.index_to_patient[:3] @ [*index, 1], expected, atol=1e-7)


def test_a_real_sweep_of_frames_is_not_taken_for_a_volume(shared_file):
    for name in ("imfusion-liver-sweep/liver_sweep", "cases/ibis-sequence/ibis"):
        path = shared_file(f"{name}.igs.mha")
        assert "tracked frames" in describe_sequence(path)
        refused(path, "tracked frames")


@pytest.mark.parametrize(
    ("kinds", "frames", "message"),
    [
        ("domain domain domain", 1, None),
        ("domain domain list", 1, "without poses"),
        ("", 1, None),
    ],
)
def test_volumes_and_sequences_are_told_apart_by_their_axes_or_frames(
    tmp_path, kinds, frames, message
):
    fields = {f"Seq_Frame{k:04d}_ImageStatus": "OK" for k in range(frames)}
    path = _metaimage(tmp_path / "a.mha", **({"Kinds": kinds} if kinds else {}), **fields)
    if message is None:
        assert read_volume(path).shape == (4, 5, 6)
    else:
        refused(path, message)


@pytest.mark.parametrize(
    ("fields", "data", "message"),
    [
        ({}, b"\0" * 60, "holds 60 bytes .* 120"),
        ({"CompressedData": "True"}, zlib.compress(bytes(60)), "60 bytes .* 120"),
        ({"CompressedData": "True"}, zlib.compress(bytes(120))[:-5], "broken or cut"),
        ({"ElementSpacing": "0 1 1"}, None, "spacing 0 × 1 × 1 mm"),
        ({"TransformMatrix": "1 0 0 1 0 0 0 0 1"}, None, "singular"),
        ({"Offset": "0 0 1e9"}, None, "1e\\+06 m"),
        ({"DistanceUnits": "furlong"}, None, "furlong"),
        ({"DimSize": "1024 1024 1024"}, None, "536870912"),
    ],
)
def test_a_metaimage_that_is_no_volume_is_refused(tmp_path, fields, data, message):
    refused(_metaimage(tmp_path / "bad.mha", data, **fields), message)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["sizes: 4 5 7"], "holds 240 bytes .* 280"),
        (["encoding: bzip2"], "broken"),
        (["space: scanner-xyz"], "scanner-xyz"),
    ],
)
def test_an_nrrd_header_that_does_not_fit_is_refused(tmp_path, lines, message):
    refused(_nrrd(tmp_path / "a.nrrd", MARKED, *PLACED, *lines), message)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"datatype": 4}, "120"),
        ({"srow_x": (1, 0.4, 0, 0)}, "22°"),
        ({"pixdim": (1, 1, 1, 2, 0, 0, 0, 0)}, "two sizes"),
        # Never taken for 1 mm.
        ({"sform_code": 0, "pixdim": (1, 0, 0, 0, 0, 0, 0, 0)}, "--spacing"),
    ],
)
def test_a_nifti_header_that_does_not_fit_is_refused(tmp_path, fields, message):
    refused(_nifti(tmp_path / "a.nii", GREY, np.eye(4), **fields), message)


@pytest.mark.parametrize("suffix", ["mha", "nii.gz", "txt"])
def test_what_is_no_image_or_a_part_of_one_is_refused(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    if suffix != "txt":
        sitk.WriteImage(sitk.GetImageFromArray(np.resize(GREY, (20, 20, 20))), str(path), True)
        path.write_bytes(path.read_bytes()[:-40])
        refused(path, "bytes|broken or cut")
    for content in (b"", b"no image at all\n" * 40):
        path.write_bytes(content)
        refused(path, "an image")


def test_what_is_not_there_is_named(tmp_path):
    refused(tmp_path / "nowhere.mha", "no such file")
    refused(tmp_path, "no DICOM files")
    for header, data in (("a.mhd", "a.raw"), ("a.nhdr", "a.raw"), ("a.hdr", "a.img")):
        _stored(tmp_path / header, GREY)
        (tmp_path / data).unlink()
        refused(tmp_path / header, data)


@pytest.mark.parametrize(("slope", "intercept"), [(2.0, -10.0), (1.0, 3.0), (-1.0, 255.0)])
def test_stored_numbers_of_nifti_that_stand_for_others_are_read_as_those(
    tmp_path, slope, intercept
):
    ramp = np.arange(256, dtype=np.uint8).reshape(8, 8, 4)
    path = _nifti(tmp_path / "a.nii", ramp, np.eye(4), scl_slope=slope, scl_inter=intercept)
    expected = ramp if slope > 0 else 255 - ramp  # stretched over all grey values
    np.testing.assert_array_equal(read_volume(path).intensities, expected)


@pytest.mark.parametrize(
    ("lines", "data"),
    [
        (["endian: big"], RAW.astype(">i2").tobytes(order="F")),
        (["encoding: gz"], gzip.compress(MARKED)),
        (["encoding: bzip2"], bz2.compress(MARKED)),
        (["byte skip: -1"], b"more or less" + MARKED),
    ],
)
def test_nrrd_is_read_in_every_encoding_and_behind_what_is_skipped(tmp_path, lines, data):
    volume = read_volume(_nrrd(tmp_path / "a.nrrd", data, *PLACED, *lines))
    np.testing.assert_array_equal(volume.intensities, SPREAD)
    (tmp_path / "a.bin").write_bytes(data)
    header = _nrrd(tmp_path / "a.nhdr", b"", *PLACED, "data file: a.bin", *lines)
    np.testing.assert_array_equal(read_volume(header).intensities, SPREAD)


@pytest.mark.parametrize("space", ["LPS", "right-anterior-superior"])
def test_nrrd_lies_where_itk_says_in_every_space(tmp_path, space):
    lines = (f"space: {space}", "space directions: (0,0.5,0) (-0.25,0,0) (0,0,2)")
    path = _nrrd(tmp_path / "a.nrrd", MARKED, *lines, "space origin: (1,2,3)")
    expected = np.array(sitk.ReadImage(str(path)).TransformIndexToPhysicalPoint((1, 2, 3)))
    np.testing.assert_allclose((read_placement(path) @ [1, 2, 3, 1])[:3] * 1e3, expected)


@pytest.mark.parametrize(
    ("lines", "scale"),
    [
        (('space units: "µm" "um" "micron"', *PLACED), 1e-3),
        (('space units: "mm" "mm" "um"', *PLACED), (1.0, 1.0, 1e-3)),
        (("spacings: 0.05 0.025 0.2", 'units: "cm" "cm" "cm"', "axis mins: 0.7 0.8 0.9"), 1.0),
    ],
)
def test_units_of_nrrd_count(tmp_path, lines, scale):
    there = read_placement(_nrrd(tmp_path / "a.nrrd", MARKED, *lines)) * 1e3
    np.testing.assert_allclose(np.diag(there)[:3], np.multiply([0.5, 0.25, 2], scale))
    np.testing.assert_allclose(there[:3, 3], np.multiply([7, 8, 9], scale))


def test_a_spacing_that_is_not_stated_is_asked_for_and_one_that_is_stays(tmp_path):
    bare = _nrrd(tmp_path / "a.nrrd", MARKED)
    refused(bare, "--spacing X,Y,Z")
    there = open_image(bare).placement((0.5, 0.25, 2))
    np.testing.assert_allclose(np.diag(there), [0.5e-3, 0.25e-3, 2e-3, 1])
    with pytest.raises(VolumeError, match="leave out"):
        open_image(_metaimage(tmp_path / "a.mha")).placement((1, 1, 1))


def test_two_sizes_of_a_nifti_file_are_told_and_the_right_one_can_be_said(shared_file):
    # As nibabel 5.4 reads NIfTI 2, which SimpleITK does not.
    there = open_image(shared_file("foreign-files/example_nifti2.nii.gz")).placement() * 1e3
    np.testing.assert_allclose(np.linalg.norm(there[:3, :3], axis=0), (2.0, 2.0, 2.2), rtol=1e-6)
    np.testing.assert_allclose(there[:3, 3], (-117.8551, 35.72294, -7.2488), rtol=1e-5)
    for name, sizes in (
        ("itk3514_vinci", (0.865759, 0.865759, 0.796)),
        ("ants1675", (0.9375, 0.9375, 1.2)),
    ):
        path = shared_file(f"cases/nifti-unit-sform/{name}.nii")
        refused(path, rf"1 × 1 × 1 and {sizes[0]} .*--spacing")
        there = open_image(path).placement(sizes)
        np.testing.assert_allclose(np.linalg.norm(there[:3, :3], axis=0) * 1e3, sizes)


def test_axes_that_are_rounded_are_read_and_written_and_sheared_ones_refused(shared_file, tmp_path):
    rounded = read_volume(shared_file("cases/nifti-shear/shear_2e-4.nii"))
    for suffix in (".nii", ".nrrd", ".mha"):
        write_volume(tmp_path / f"a{suffix}", rounded)
        there = read_placement(tmp_path / f"a{suffix}")
        np.testing.assert_allclose(there, rounded.index_to_patient, atol=1e-8)
    refused(shared_file("cases/nifti-shear/shear_2e-2.nii"), r"1\.1°")


def test_radio_frequency_data_are_told_from_b_mode(shared_file):
    refused(shared_file("cases/metaimage-rf/MouseLiverRF.mha"), "radio-frequency")
    volume = read_volume(shared_file("cases/metaimage-rf/MouseLiverB.mha"))
    assert volume.shape == (128, 512, 4)
