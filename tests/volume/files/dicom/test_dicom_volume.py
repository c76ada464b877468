"""DICOM volumes: where their voxels are, by every way in which a header states it."""

from pathlib import Path

import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
from made_dicom import US_IMAGE, enhanced, header, item, turned, write
from pydicom.data import get_testdata_file
from pydicom.uid import ImplicitVRLittleEndian, generate_uid

from us_sim.errors import VolumeError
from us_sim.volume.files.dicom.placed_images import open_images, place_images
from us_sim.volume.files.readers import read_placement, read_volume

MR_IMAGE = "1.2.840.10008.5.1.4.1.1.4"

VOXELS = np.random.default_rng(5).integers(0, 256, (7, 6, 5), dtype=np.uint8)
PLACED = turned()


@pytest.mark.parametrize(
    ("order", "how"),
    [
        (None, {}),
        ([3, 0, 4, 1, 2], {"syntax": ImplicitVRLittleEndian}),
        ([4, 3, 2, 1, 0], {"deflated": True}),
    ],
)
def test_an_enhanced_volume_lies_where_its_groups_say(tmp_path, order, how):
    path = write(tmp_path / "volume.dcm", enhanced(VOXELS, PLACED, order=order), **how)
    volume = read_volume(path)
    np.testing.assert_array_equal(volume.intensities, VOXELS)
    np.testing.assert_allclose(volume.index_to_patient[:3], PLACED[:3] * 1e-3, atol=1e-12)
    np.testing.assert_array_equal(read_placement(path), volume.index_to_patient)


def test_of_several_volumes_each_can_be_had_and_the_echoes_are_taken(tmp_path):
    made = enhanced(VOXELS, PLACED, times=3)
    path = write(tmp_path / "a.dcm", made)
    for time in (1, 2, 3):
        voxels = place_images(open_images([path]), volume=time).read_voxels()
        np.testing.assert_array_equal(voxels, VOXELS + np.uint8(time - 1))
    with pytest.raises(VolumeError, match=r"3 volumes .*4"):
        place_images(open_images([path]), volume=4)
    for n, group in enumerate(made.PerFrameFunctionalGroupsSequence):
        kind = "TISSUE_INTENSITY" if 5 <= n < 10 else "FLOW_VELOCITY"
        group.ImageDataTypeSequence = [item(DataType=kind)]
    np.testing.assert_array_equal(read_volume(write(path, made)).intensities, VOXELS + np.uint8(1))


def single_files(folder: Path, **more) -> list[Path]:
    """A file for each slice, as SimpleITK's own reader of series wants them."""
    axes = PLACED[:3, :3] / np.linalg.norm(PLACED[:3, :3], axis=0)
    more = {"SeriesInstanceUID": generate_uid(), "FrameOfReferenceUID": generate_uid()} | more
    more |= {"ImageOrientationPatient": np.round(axes[:, :2].T.ravel(), 9).tolist()}
    paths = []
    for k in range(5):
        at = np.round(PLACED[:3, 3] + k * PLACED[:3, 2], 9).tolist()
        image = VOXELS[:, :, k].T[None].copy()
        made = header(image, MR_IMAGE, InstanceNumber=k + 1, PixelSpacing=[0.25, 0.5], **more)
        made.ImagePositionPatient = at
        del made.NumberOfFrames
        paths.append(write(folder / f"{(k * 3) % 5}.dcm", made))
    return paths


def require_simpleitks(placed, folder):
    reader = sitk.ImageSeriesReader()
    reader.SetFileNames(reader.GetGDCMSeriesFileNames(str(folder)))
    image = reader.Execute()
    for index in ((0, 0, 0), (5, 4, 3)):
        expected = np.array(image.TransformIndexToPhysicalPoint(index)) * 1e-3
        np.testing.assert_allclose(placed.placement[:3] @ [*index, 1], expected, atol=1e-9)
    stored = sitk.GetArrayFromImage(image).T.astype(float)
    spread = (stored - stored.min()) / np.ptp(stored) * 255 if np.ptp(stored) > 255 else stored
    assert np.abs(placed.read_voxels() - spread).max() <= 0.5 + 1e-9


def test_series_of_files_lie_where_simpleitk_says(tmp_path):
    require_simpleitks(place_images(open_images(single_files(tmp_path)[::-1])), tmp_path)
    files = real_series("98892001/CT5N")
    require_simpleitks(place_images(open_images(files)), files[0].parent)


def real_series(name):
    """Files of a real series that comes with pydicom."""
    folder = Path(get_testdata_file("CT_small.dcm")).parent / "dicomdirtests" / name
    if not folder.is_dir():
        pytest.skip(f"pydicom has come without {folder}")
    return [file for file in sorted(folder.iterdir()) if file.is_file()]


def test_a_makers_own_volume_is_refused_with_what_to_do(tmp_path):
    made = header(VOXELS[:, :, :1].transpose(2, 1, 0).copy(), US_IMAGE)
    made.add_new(0x7FE10011, "LO", "KRETZ_US")
    path = write(tmp_path / "a.dcm", made)
    with pytest.raises(VolumeError, match="SlicerHeart"):
        read_volume(path)
    del made.PixelData
    made.save_as(path, enforce_file_format=True)
    with pytest.raises(VolumeError, match=r"no image.*SlicerHeart"):
        read_volume(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda g: place(g[2], 0, 0.7), "one may be missing"),
        (lambda g: place(g[2], 1, 3.0), "shifted"),
        (lambda g: g.__setitem__(2, g[1]), "same place"),
        (None, "right angles"),
    ],
)
def test_images_that_are_no_grid_are_refused(tmp_path, change, message):
    made = enhanced(VOXELS, np.diag([0.5, 0.25, 2.0, 1.0]))
    if change:
        change(made.PerFrameFunctionalGroupsSequence)
    else:
        axes = made.SharedFunctionalGroupsSequence[0].PlaneOrientationVolumeSequence[0]
        axes.ImageOrientationVolume = [1, 0, 0, 0.5, 1, 0]
    path = write(tmp_path / "a.dcm", made)
    with pytest.raises(VolumeError, match=message) as refused:
        read_volume(path)
    assert str(refused.value).startswith(f"{path}: ")


def place(group, axis, by):
    """Move an image: along the normal (0), or within its plane (1)."""
    at = group.PlanePositionVolumeSequence[0]
    moved = list(at.ImagePositionVolume)
    moved[2 if axis == 0 else 0] += by
    at.ImagePositionVolume = moved


def test_files_of_two_series_and_one_slice_are_refused(tmp_path):
    paths = single_files(tmp_path)
    with pytest.raises(VolumeError, match="one slice"):
        read_volume(paths[0])
    made = pydicom.dcmread(paths[0])
    made.SeriesInstanceUID = generate_uid()
    made.save_as(paths[0])
    with pytest.raises(VolumeError, match="several series"):
        place_images(open_images(paths))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("dicom-us-2d/examples_ybr_color.dcm", "30 images"),
        ("dicom-us-2d/US1_UNCR.dcm", "2D image"),
    ],
)
def test_a_real_file_that_is_no_volume_is_called_what_it_is(shared_file, name, message):
    path = shared_file(name)
    with pytest.raises(VolumeError, match=message):
        read_volume(path)


def test_images_at_one_place_are_a_cine_and_no_volume(tmp_path):
    made = enhanced(VOXELS[:, :, :1], turned(), times=5)
    path = write(tmp_path / "a.dcm", made)
    with pytest.raises(VolumeError, match="5 images at one place"):
        place_images(open_images([path]))
