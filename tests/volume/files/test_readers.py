"""Volume files: hand-written MetaImage, NRRD and NIfTI, what SimpleITK writes, and real ones."""

import bz2
import gzip
import struct
import zlib

import nibabel
import numpy as np
import pytest
import SimpleITK as sitk

from us_sim.errors import VolumeError
from us_sim.volume.files import stored_image
from us_sim.volume.files.readers import (
    grey_voxels,
    open_image,
    read_placement,
    read_volume,
    sequence_use,
)
from us_sim.volume.files.writing import write_volume

SHAPE = (4, 5, 6)
GREY = np.random.default_rng(2).integers(0, 256, SHAPE, dtype=np.uint8)
MATRIX_RAS = np.array([[2.0, 0, 0, 5], [0, 0, -3, 6], [0, 4, 0, 7], [0, 0, 0, 1]])
MATRIX_LPS = np.diag([-1e-3, -1e-3, 1e-3, 1.0]) @ MATRIX_RAS


def _metaimage(path, data=None, **fields):
    """A MetaImage file of uint8 voxels (i, j, k) written field by field, i fastest."""
    header = {
        "ObjectType": "Image",
        "NDims": "3",
        "BinaryData": "True",
        "BinaryDataByteOrderMSB": "False",
        "CompressedData": "False",
        "TransformMatrix": "1 0 0 0 1 0 0 0 1",
        "Offset": "0 0 0",
        "ElementSpacing": "1 1 1",
        "DimSize": "4 5 6",
        "ElementType": "MET_UCHAR",
        **fields,
        "ElementDataFile": "LOCAL",
    }
    text = "".join(f"{key} = {value}\n" for key, value in header.items())
    path.write_bytes(text.encode() + (GREY.tobytes(order="F") if data is None else data))
    return path


def _stored(path, voxels):
    """A file of an array (k, j, i), as SimpleITK writes it."""
    sitk.WriteImage(sitk.GetImageFromArray(voxels), str(path))
    return path


def _changed(path, at, form, *values):
    """A file with other values at a place in it."""
    content = bytearray(path.read_bytes())
    struct.pack_into(form, content, at, *values)
    path.write_bytes(content)
    return path


def _nifti(path, voxels, matrix_ras, kind=nibabel.Nifti1Image, unit="mm"):
    """A NIfTI file placed by its sform alone."""
    image = kind(voxels, None)
    image.set_sform(matrix_ras, code=1)
    steps = np.linalg.norm(matrix_ras[:3, :3], axis=0)
    image.header.set_zooms((*steps, *voxels.shape[3:]))
    image.header.set_xyzt_units(unit)
    nibabel.save(image, path)
    return path


def refused(path, message):
    """One sentence that begins with the file."""
    with pytest.raises(VolumeError, match=message) as error:
        read_volume(path)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)


def test_axis_0_is_the_files_fastest_and_the_header_places_the_voxels(tmp_path):
    # MetaImage gives one axis after another: i along y, j along z, k along x.
    turn = {"TransformMatrix": "0 1 0 0 0 1 1 0 0", "ElementSpacing": "0.5 2 3"}
    volume = read_volume(_metaimage(tmp_path / "a.mha", **turn, Offset="10 20 -30"))
    np.testing.assert_array_equal(volume.intensities, GREY)
    assert volume.intensities.flags.c_contiguous
    expected = [0.010 + 4 * 3e-3, 0.020 + 2 * 0.5e-3, -0.030 + 3 * 2e-3, 1.0]
    np.testing.assert_allclose(volume.index_to_patient @ [2, 3, 4, 1], expected, atol=1e-12)


@pytest.mark.parametrize("suffix", [".mha", ".nrrd", ".nii", ".nii.gz"])
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


@pytest.mark.parametrize("dtype", [np.int8, np.int16, np.uint16, np.int32, np.float32, np.float64])
def test_other_types_are_spread_over_the_whole_range(tmp_path, dtype):
    lowest = 0 if dtype == np.uint16 else -100
    stored = (lowest + np.array([0, 51, 102, 153, 204])).astype(dtype)
    grey = read_volume(_stored(tmp_path / "a.nrrd", np.resize(stored, (5, 5, 5)))).intensities
    # 0, 1/4, 1/2, 3/4 and 1 of 255, halves rounded up.
    np.testing.assert_array_equal(grey[:, 0, 0], [0, 64, 128, 191, 255])


def test_a_float_image_may_have_holes_and_a_vast_range(tmp_path):
    stored = np.zeros((3, 3, 3))
    stored[0, 0] = [-1.7e308, np.nan, 1.7e308]
    stored[0, 1] = [np.inf, -np.inf, 0.0]
    grey = read_volume(_stored(tmp_path / "a.nrrd", stored)).intensities[:, :, 0]
    np.testing.assert_array_equal(grey[:, 0], [0, 0, 255])
    np.testing.assert_array_equal(grey[:, 1], [255, 0, 128])
    (_, missing, infinite) = grey_voxels(open_image(tmp_path / "a.nrrd"))[1]
    assert missing.startswith("1 values")
    assert infinite.startswith("2 infinite")


def test_a_constant_image_is_dark_and_one_without_a_number_is_refused(tmp_path):
    path = _stored(tmp_path / "a.nrrd", np.full((3, 3, 3), 7, np.int16))
    assert not read_volume(path).intensities.any()
    _stored(path, np.full((3, 3, 3), np.nan))
    refused(path, "finite")


@pytest.mark.parametrize(
    ("name", "origin"),
    [
        (
            "imfusion-liver-sweep/liver_sweep_compounded_1mm",
            (-157.461058097, -95.903891754, 19.73177),
        ),
        # With the status of a frame in its header, and with the axes of a sequence.
        ("plus-spine-freehand/VolumeReconstructorTestNNMEANvolumeRef", (-74.5217, 165.573, 29.072)),
        (
            "plus-nwire-calibration/NwirePhantomFreehandReconstructed",
            (-22.2573, -137.793, -58.5829),
        ),
    ],
)
def test_real_volumes_are_what_simpleitk_reads(shared_file, name, origin):
    path = shared_file(f"{name}.mha")
    volume = read_volume(path)
    stored = sitk.GetArrayFromImage(sitk.ReadImage(str(path))).transpose(2, 1, 0)
    np.testing.assert_array_equal(volume.intensities, stored)
    np.testing.assert_allclose(volume.index_to_patient[:3, 3] * 1e3, origin, atol=1e-5)


def test_a_real_sweep_of_frames_is_not_taken_for_a_volume(shared_file):
    refused(shared_file("imfusion-liver-sweep/liver_sweep.igs.mha"), "tracked frames")
    path = shared_file("cases/ibis-sequence/ibis.igs.mha")  # frame numbers of ten digits
    assert "tracked frames" in sequence_use(path)
    refused(path, "tracked frames")


@pytest.mark.parametrize(
    ("kinds", "frames", "message"),
    [
        ("domain domain domain", 1, None),
        ("domain domain list", 0, None),
        ("domain domain list", 1, "without poses"),
        ("domain domain time", 0, "without poses"),
        ("", 1, None),
        ("", 2, "without poses"),
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
        ({}, b"\0" * 121, "holds 121 bytes .* 120"),
        ({"ElementType": "MET_SHORT"}, None, "header says 240"),
        ({"ElementSpacing": "0 1 1"}, None, "spacing 0 × 1 × 1 mm"),
        ({"ElementSpacing": "1 -2 1"}, None, "spacing 1 × -2 × 1 mm"),
        ({"ElementSpacing": "1 nan 1"}, None, "ElementSpacing"),
        ({"TransformMatrix": "1 0 0 1 0 0 0 0 1"}, None, "singular"),
        ({"TransformMatrix": "1 0 0 0.5 1 0 0 0 1"}, None, "27°"),
        ({"TransformMatrix": "2 0 0 0 2 0 0 0 2"}, None, "scaled"),
        ({"Offset": "0 0"}, None, "Offset"),
        ({"Offset": "0 0 1e9"}, None, "1e\\+06 m"),
        ({"DistanceUnits": "furlong"}, None, "furlong"),
        ({"DimSize": "4 5 1"}, b"\0" * 20, "each axis"),
        ({"DimSize": "-4 5 6"}, None, "DimSize"),
        ({"DimSize": "1024 1024 1024"}, None, "536870912"),
        ({"NDims": "2", "DimSize": "4 30"}, None, "2-dimensional"),
        ({"DimSize": "2 5 6", "ElementNumberOfChannels": "2"}, None, "2 numbers"),
        ({"ElementType": "MET_STRING"}, None, "MET_STRING"),
        ({"HeaderSize": "-2"}, None, "HeaderSize"),
        ({"BinaryData": "False"}, b"1 2 3", "binary"),
    ],
)
def test_a_metaimage_that_is_no_volume_is_refused(tmp_path, fields, data, message):
    refused(_metaimage(tmp_path / "bad.mha", data, **fields), message)


def test_a_compressed_metaimage_holds_what_its_header_says(tmp_path):
    """Where SimpleITK makes an image of what was in memory."""

    def packed(data):
        return _metaimage(tmp_path / "a.mha", data, CompressedData="True")

    whole = GREY.tobytes(order="F")
    np.testing.assert_array_equal(read_volume(packed(zlib.compress(whole))).intensities, GREY)
    refused(packed(zlib.compress(whole[:60])), "60 bytes .* 120")
    refused(packed(zlib.compress(whole + bytes(100 << 20))), "121 or more bytes .* 120")
    refused(packed(zlib.compress(whole)[:-20]), "broken or cut")


def test_a_volume_that_the_memory_does_not_hold_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(stored_image, "free_memory", lambda: 200.0)
    refused(_metaimage(tmp_path / "a.mha"), "GB")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("sizes: 4 5 6", "sizes: 4 5 7", "holds 120 bytes .* 140"),
        ("sizes: 4 5 6", "sizes: 4 5 6 1", "dimension"),
        ("sizes: 4 5 6", "sizes: 4 5 -6", "above zero"),
        ("space directions: ", "space directions: " + 25 * "(1,0,0) ", "28 entries"),
        ("space origin: (0,0,0)", "space origin: (0,0,nan)", "origin"),
        ("encoding: raw", "encoding: hex", "'hex'"),
        ("encoding: raw", "encoding: ascii", "'ascii'"),
        ("encoding: raw", "encoding: raw\nline skip: 2", "behind lines"),
        ("encoding: raw", "encoding: raw\nbyte skip: 9", "holds 111 bytes"),
        ("encoding: raw", "encoding: bzip2", "broken"),
        ("space: left-posterior-superior", "space: scanner-xyz", "scanner-xyz"),
        ("space directions: ", "space units: furlong mm mm\nspace directions: ", "furlong"),
    ],
)
def test_an_nrrd_header_that_does_not_fit_is_refused(tmp_path, old, new, message):
    path = _stored(tmp_path / "a.nrrd", GREY.T)
    content = path.read_bytes()
    assert old.encode() in content
    path.write_bytes(content.replace(old.encode(), new.encode()))
    refused(path, message)


@pytest.mark.parametrize(
    ("at", "form", "value", "message"),
    [
        (40, "<2h", (3, -4), "each axis"),
        (70, "<h", (4,), "holds 120 bytes .* 240"),
        (70, "<h", (77,), "77"),
        (108, "<f", (np.nan,), "an image"),
        (108, "<f", (1e9,), "holds 0 bytes"),
        (288, "<f", (0.4,), "22°"),
        (344, "<i", (0,), "an image"),
        (76, "<4f", (1, 1, 1, 2), "two sizes"),
    ],
)
def test_a_nifti_header_that_does_not_fit_is_refused(tmp_path, at, form, value, message):
    path = _nifti(tmp_path / "a.nii", GREY, np.eye(4))
    refused(_changed(path, at, form, *value), message)


@pytest.mark.parametrize("suffix", [".mha", ".nrrd", ".nii", ".nii.gz"])
@pytest.mark.parametrize("compressed", [False, True])
def test_a_cut_file_is_refused(tmp_path, suffix, compressed):
    path = tmp_path / f"cut{suffix}"
    image = sitk.GetImageFromArray(np.resize(GREY, (20, 20, 20)))
    sitk.WriteImage(image, str(path), compressed)
    path.write_bytes(path.read_bytes()[:-40])
    refused(path, "bytes of image data|broken or cut")


@pytest.mark.parametrize("name", ["note.txt", "note.mha", "note.nii", "note.nrrd", "note"])
def test_what_is_no_image_is_refused(tmp_path, name):
    for content in (b"", b"no image at all\n" * 40):
        (tmp_path / name).write_bytes(content)
        refused(tmp_path / name, "an image")


def test_what_is_not_there_is_named(tmp_path):
    refused(tmp_path / "nowhere.mha", "no such file")
    refused(tmp_path, "no DICOM files")
    image = sitk.GetImageFromArray(GREY)
    for header, data in (("a.mhd", "a.raw"), ("a.nhdr", "a.raw"), ("a.hdr", "a.img")):
        sitk.WriteImage(image, str(tmp_path / header))
        (tmp_path / data).unlink()
        refused(tmp_path / header, data)


@pytest.mark.parametrize("suffix", [".nii", ".nii.gz"])
@pytest.mark.parametrize(("slope", "intercept"), [(2.0, -10.0), (1.0, 3.0), (-1.0, 255.0)])
def test_stored_numbers_of_nifti_that_stand_for_others_are_read_as_those(
    tmp_path, suffix, slope, intercept
):
    ramp = np.arange(256, dtype=np.uint8).reshape(4, 8, 8)
    path = _stored(tmp_path / "a.nii", ramp)
    _changed(path, 112, "<2f", slope, intercept)
    if suffix == ".nii.gz":
        (tmp_path / "a.nii.gz").write_bytes(gzip.compress(path.read_bytes()))
    read = read_volume(tmp_path / f"a{suffix}").intensities
    expected = ramp if slope > 0 else 255 - ramp  # stretched over all grey values
    np.testing.assert_array_equal(read, expected.T)


RAW = GREY.astype("<i2") * 3
MARKED = RAW.tobytes(order="F")
SPREAD = np.floor((RAW - RAW.min()) / np.ptp(RAW) * 255.0 + 0.5).astype(np.uint8)


def _nrrd(path, data, *lines):
    """An NRRD file of int16 voxels with further lines."""
    said = ["NRRD0004", "type: short", "dimension: 3", "sizes: 4 5 6", *lines]
    said += [] if any("endian" in line for line in lines) else ["endian: little"]
    path.write_bytes("\n".join([*said, "", ""]).encode() + data)
    return path


PLACED = ("space: LPS", "space directions: (0.5,0,0) (0,0.25,0) (0,0,2)", "space origin: (7,8,9)")


@pytest.mark.parametrize(
    ("encoding", "data"),
    [
        ("raw", MARKED),
        ("raw\nendian: big", RAW.astype(">i2").tobytes(order="F")),
        ("gz", gzip.compress(MARKED)),
        ("bzip2", bz2.compress(MARKED)),
        ("raw\nbyte skip: 9", b"123456789" + MARKED),
        ("raw\nbyte skip: -1", b"more or less" + MARKED),
    ],
)
def test_nrrd_is_read_in_every_encoding_and_behind_what_is_skipped(tmp_path, encoding, data):
    volume = read_volume(_nrrd(tmp_path / "a.nrrd", data, *PLACED, f"encoding: {encoding}"))
    np.testing.assert_array_equal(volume.intensities, SPREAD)
    (tmp_path / "a.bin").write_bytes(data)
    header = _nrrd(tmp_path / "a.nhdr", b"", *PLACED, "data file: a.bin", f"encoding: {encoding}")
    np.testing.assert_array_equal(read_volume(header).intensities, SPREAD)


@pytest.mark.parametrize(
    ("fields", "data"),
    [
        ({"HeaderSize": "3"}, b"123" + MARKED),
        ({"HeaderSize": "-1"}, b"12345" + MARKED),
        ({"BinaryDataByteOrderMSB": "True"}, RAW.astype(">i2").tobytes(order="F")),
    ],
)
def test_metaimage_is_read_behind_other_headers(tmp_path, fields, data):
    path = _metaimage(tmp_path / "a.mha", data, ElementType="MET_SHORT", **fields)
    np.testing.assert_array_equal(read_volume(path).intensities, SPREAD)


@pytest.mark.parametrize("space", ["LPS", "right-anterior-superior", "LAS"])
def test_nrrd_lies_where_itk_says_in_every_space(tmp_path, space):
    lines = (f"space: {space}", "space directions: (0,0.5,0) (-0.25,0,0) (0,0,2)")
    path = _nrrd(tmp_path / "a.nrrd", MARKED, *lines, "space origin: (1,2,3)", "encoding: raw")
    image = sitk.ReadImage(str(path))
    expected = np.array(image.TransformIndexToPhysicalPoint((1, 2, 3))) * 1e-3
    np.testing.assert_allclose((read_placement(path) @ [1, 2, 3, 1])[:3], expected, atol=1e-12)


@pytest.mark.parametrize(
    ("lines", "scale"),
    [
        (('space units: "cm" "cm" "cm"', *PLACED), 10.0),
        (('space units: "µm" "um" "micron"', *PLACED), 1e-3),
        (('space units: "mm" "mm" "um"', *PLACED), (1.0, 1.0, 1e-3)),
        (("spacings: 0.05 0.025 0.2", 'units: "cm" "cm" "cm"'), 1.0),
        (("spacings: 0.5 0.25 2", "axis mins: 7 8 9"), 1.0),
    ],
)
def test_units_of_nrrd_count(tmp_path, lines, scale):
    path = _nrrd(tmp_path / "a.nrrd", MARKED, "encoding: raw", *lines)
    there = read_placement(path)
    np.testing.assert_allclose(np.diag(there)[:3] * 1e3, np.multiply([0.5, 0.25, 2], scale))
    if "axis mins: 7 8 9" in lines or lines[-1].startswith("space origin"):
        np.testing.assert_allclose(there[:3, 3] * 1e3, np.multiply([7, 8, 9], scale))


@pytest.mark.parametrize(("unit", "scale"), [("um", 1e-3), ("cm", 10.0), ("mm", 1.0)])
def test_units_of_metaimage_count(tmp_path, unit, scale):
    path = _metaimage(tmp_path / "a.mha", DistanceUnits=unit, Offset="4 5 6")
    np.testing.assert_allclose(read_placement(path)[0], [scale * 1e-3, 0, 0, scale * 4e-3])


def test_a_spacing_that_is_not_stated_is_asked_for_and_one_that_is_stays(tmp_path):
    bare = _nrrd(tmp_path / "a.nrrd", MARKED, "encoding: raw")
    refused(bare, "--spacing X,Y,Z")
    there = open_image(bare, spacing=(0.5, 0.25, 2)).placement()
    np.testing.assert_allclose(np.diag(there), [0.5e-3, 0.25e-3, 2e-3, 1])
    with pytest.raises(VolumeError, match="leave out"):
        open_image(_metaimage(tmp_path / "a.mha"), spacing=(1, 1, 1)).placement()


def test_nifti_2_in_one_file_and_in_two_is_read(tmp_path):
    _nifti(tmp_path / "a.nii", RAW, MATRIX_RAS, nibabel.Nifti2Image)
    _nifti(tmp_path / "b.hdr", RAW, MATRIX_RAS, nibabel.Nifti2Pair)
    _nifti(tmp_path / "c.hdr", RAW, MATRIX_RAS, nibabel.Nifti1Pair)
    microns = np.diag([1e3, 1e3, 1e3, 1]) @ MATRIX_RAS
    _nifti(tmp_path / "d.nii.gz", RAW, microns, unit="micron")
    for name in ("a.nii", "b.hdr", "b.img", "c.img", "d.nii.gz"):
        volume = read_volume(tmp_path / name)
        np.testing.assert_array_equal(volume.intensities, SPREAD)
        np.testing.assert_allclose(volume.index_to_patient, MATRIX_LPS, atol=1e-9)


@pytest.mark.parametrize("mirror", [1.0, -1.0])
def test_the_quaternion_of_nifti_turns_as_in_itk(tmp_path, mirror):
    path = _nifti(tmp_path / "a.nii", GREY, MATRIX_RAS)
    _changed(path, 76, "<4f", mirror, 0.5, 0.25, 2.0)
    _changed(path, 252, "<2h6f", 1, 0, 0.3, -0.5, 0.2, 4.0, 5.0, 6.0)
    image = sitk.ReadImage(str(path))
    for index in ((0, 0, 0), (3, 0, 0), (0, 4, 0), (1, 2, 5)):
        expected = np.array(image.TransformIndexToPhysicalPoint(index)) * 1e-3
        np.testing.assert_allclose((read_placement(path) @ [*index, 1])[:3], expected, atol=1e-8)


def test_of_several_volumes_one_is_read_by_its_number(tmp_path):
    path = _nifti(tmp_path / "a.nii", np.stack([RAW, RAW[::-1]], axis=-1), MATRIX_RAS)
    refused(path, "holds 2 volumes")
    image = open_image(path)
    np.testing.assert_array_equal(grey_voxels(image, 2)[0], SPREAD[::-1])
    with pytest.raises(VolumeError, match="number 3"):
        grey_voxels(image, 3)


@pytest.mark.parametrize(
    ("name", "spacing", "origin"),
    [
        ("units_cm.nrrd", (2.0, 1.5, 1.2), (10.0, -20.0, 30.0)),
        # As nibabel 5.4 reads it.
        ("example_nifti2.nii.gz", (2.0, 2.0, 2.2), (-117.8551, 35.72294, -7.2488)),
    ],
)
def test_real_files_lie_where_other_programs_say(shared_file, name, spacing, origin):
    path = shared_file(f"foreign-files/{name}")
    there = open_image(path).placement() * 1e3
    np.testing.assert_allclose(np.linalg.norm(there[:3, :3], axis=0), spacing, rtol=1e-6)
    np.testing.assert_allclose(there[:3, 3], origin, rtol=1e-5)


def test_two_sizes_of_a_nifti_file_are_told_and_the_right_one_can_be_said(shared_file):
    for name, sizes in (
        ("itk3514_vinci", (0.865759, 0.865759, 0.796)),
        ("ants1675", (0.9375, 0.9375, 1.2)),
    ):
        path = shared_file(f"cases/nifti-unit-sform/{name}.nii")
        refused(path, rf"1 × 1 × 1 and {sizes[0]} .*--spacing")
        there = open_image(path, spacing=sizes).placement()
        np.testing.assert_allclose(np.linalg.norm(there[:3, :3], axis=0) * 1e3, sizes)


def test_a_spacing_of_0_is_not_taken_for_1_mm(tmp_path):
    path = _nifti(tmp_path / "a.nii", GREY, np.eye(4))
    _changed(path, 254, "<h", 0)
    refused(_changed(path, 80, "<3f", 0, 0, 0), "--spacing")


def test_axes_that_are_rounded_are_read_and_written_and_sheared_ones_refused(shared_file, tmp_path):
    rounded = read_volume(shared_file("cases/nifti-shear/shear_2e-4.nii"))
    for suffix in (".nii", ".nrrd", ".mha"):
        write_volume(tmp_path / f"a{suffix}", rounded)
        there = read_placement(tmp_path / f"a{suffix}")
        np.testing.assert_allclose(there, rounded.index_to_patient, atol=1e-8)
    refused(shared_file("cases/nifti-shear/shear_2e-2.nii"), r"1\.1°")


def test_the_space_of_nrrd_is_read_and_one_of_no_body_is_refused(shared_file, tmp_path):
    folder = shared_file("cases/nrrd-space/scanner_xyz.nhdr").parent
    refused(folder / "scanner_xyz.nhdr", "scanner-xyz")
    one, other = (read_volume(folder / f"{n}.nhdr") for n in ("slicer8694_las", "the_same_in_lps"))
    np.testing.assert_allclose(one.index_to_patient, other.index_to_patient, atol=1e-12)
    np.testing.assert_array_equal(one.intensities, other.intensities)
    bare = _nrrd(tmp_path / "a.nrrd", MARKED, "encoding: raw", "spacings: 1 1 1")
    assert "assumed" in grey_voxels(open_image(bare))[1][0]


def test_radio_frequency_data_are_told_from_b_mode(shared_file):
    refused(shared_file("cases/metaimage-rf/MouseLiverRF.mha"), "radio-frequency")
    volume = read_volume(shared_file("cases/metaimage-rf/MouseLiverB.mha"))
    assert volume.shape == (128, 512, 4)
