"""Imports: their results, their refusals, their ends, and text that is burned in."""

import numpy as np
import pytest
import SimpleITK as sitk
from made_dicom import US_MULTI_FRAME, enhanced, header, item, turned, write

from us_sim.command.main import main
from us_sim.errors import UsSimError, VolumeError
from us_sim.volume.cases.case import read_case
from us_sim.volume.deidentification.importing import plan_import
from us_sim.volume.deidentification.settings import ImportSettings
from us_sim.volume.files.readers import read_volume

VOXELS = np.random.default_rng(5).integers(0, 256, (30, 24, 5), dtype=np.uint8)
CINE = np.random.default_rng(3).integers(0, 256, (4, 60, 80), dtype=np.uint8)
WHOLE = ImportSettings(keep_whole_image=True)


@pytest.fixture
def volume(tmp_path):
    return write(tmp_path / "DOE_JANE.dcm", enhanced(VOXELS, turned()))


@pytest.fixture
def burned(tmp_path):
    """A volume that states burned-in annotations."""
    made = enhanced(VOXELS, turned())
    made.BurnedInAnnotation = "YES"
    return write(tmp_path / "DOE_JANE.dcm", made)


def test_a_volume_becomes_a_case_that_can_be_opened(volume, tmp_path, capsys):
    assert main(["import", str(volume), "--out", str(tmp_path / "arm")]) == 0
    assert "30 × 24 × 5 voxels of 0.5 × 0.25 × 2 mm" in capsys.readouterr().out
    case = read_case(tmp_path / "arm")
    assert case.settings.name == "arm"
    np.testing.assert_array_equal(case.read_volume().intensities, VOXELS)
    np.testing.assert_allclose(
        case.read_placement()[0], read_volume(volume).index_to_patient, atol=1e-9
    )


def test_a_crop_leaves_every_voxel_where_it_was(volume, tmp_path):
    plan_import([volume], tmp_path / "a.nrrd", ImportSettings(crop="3,2,20,15")).write()
    part, whole = read_volume(tmp_path / "a.nrrd"), read_volume(volume)
    assert part.shape == (18, 14, 5)
    np.testing.assert_array_equal(part.intensities, VOXELS[3:21, 2:16])
    at = whole.patient_to_index @ part.index_to_patient @ [1, 1, 1, 1]
    np.testing.assert_allclose(at, [4, 3, 1, 1], atol=1e-9)


def test_where_something_is_burned_in_and_no_region_stated_a_person_decides(
    burned, tmp_path, capsys
):
    out = tmp_path / "out" / "arm.nrrd"
    out.parent.mkdir()
    assert main(["import", str(burned), "--out", str(out)]) == 1
    assert "--crop X0,Y0,X1,Y1" in capsys.readouterr().err
    assert not list(out.parent.iterdir())
    assert main(["import", str(burned), "--out", str(out), "--keep-whole-image"]) == 0


def with_regions(path, *regions):
    """A volume that states burned-in annotations, and regions of edges and kinds."""
    keys = [f"RegionLocation{key}" for key in ("MinX0", "MinY0", "MaxX1", "MaxY1")]
    made = enhanced(VOXELS, turned())
    made.BurnedInAnnotation = "YES"
    made.SequenceOfUltrasoundRegions = []
    for edges, kind in regions:
        stated = {key: edge for key, edge in zip(keys, edges, strict=True) if edge is not None}
        region = item(RegionSpatialFormat=kind[0], RegionDataType=kind[1], **stated)
        made.SequenceOfUltrasoundRegions.append(region)
    return write(path, made)


@pytest.mark.parametrize(
    ("edges", "kind", "doubt"),
    [
        ((0, 0, 40, 23), (1, 1), "40, 23.*30 × 24"),
        ((0, 0, None, 23), (1, 1), "0, 0, -1"),
        ((0, 0, 29, 23), (3, 3), "no ultrasound region"),
    ],
)
def test_regions_that_cannot_be_true_are_not_believed(tmp_path, edges, kind, doubt):
    path = with_regions(tmp_path / "a.dcm", (edges, kind))
    with pytest.raises(VolumeError, match=doubt):
        plan_import([path], tmp_path / "a.nrrd", ImportSettings()).write()


def test_nothing_outside_the_regions_is_shown_by_a_crop_either(tmp_path):
    path = with_regions(tmp_path / "a.dcm", ((6, 8, 20, 23), (1, 1)), ((0, 0, 5, 23), (0, 13)))
    expected = np.zeros_like(VOXELS)
    expected[6:21, 8:] = VOXELS[6:21, 8:]
    plan_import([path], tmp_path / "o.nrrd", ImportSettings()).write()
    np.testing.assert_array_equal(read_volume(tmp_path / "o.nrrd").intensities, expected)
    plan_import([path], tmp_path / "c.nrrd", ImportSettings(crop="3,4,12,15")).write()
    cut = read_volume(tmp_path / "c.nrrd").intensities
    np.testing.assert_array_equal(cut, expected[3:13, 4:16])
    with pytest.raises(VolumeError, match="nothing of the ultrasound regions"):
        plan_import([path], tmp_path / "d.nrrd", ImportSettings(crop="22,0,29,23")).write()


def test_images_with_places_and_a_persons_spacing_are_a_volume(shared_file, tmp_path):
    folder = shared_file("cases/dicom-single-images") / "slicer_us_without_pixel_spacing"
    for spacing, message in (
        (None, r"states where its images lie.*--spacing"),
        ("0.21239,0.21239,1", r"0\.21239 mm apart"),
    ):
        with pytest.raises(VolumeError, match=message):
            plan_import([folder], tmp_path / "o.nrrd", ImportSettings(spacing=spacing)).write()
    given = ImportSettings(spacing="0.21239,0.21239,0.21239")
    plan_import([folder], tmp_path / "o.nrrd", given).write()
    made = read_volume(tmp_path / "o.nrrd")
    assert made.shape == (64, 128, 16)
    steps = np.linalg.norm(made.index_to_patient[:3, :3], axis=0)
    np.testing.assert_allclose(steps, 0.21239e-3, rtol=1e-6)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--spacing", "0"], "three numbers"),
        (["--spacing", "1,1"], "three numbers"),
        (["--crop", "0,0,30,23"], "29"),
        (["--crop", "5,5,4,9"], "rectangle"),
    ],
)
def test_wrong_options_are_refused(volume, tmp_path, more, message, capsys):
    assert main(["import", str(volume), "--out", str(tmp_path / "o.mha"), *more]) == 1
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1
    assert list(tmp_path.iterdir()) == [volume]


def test_files_and_outputs_that_do_not_fit_are_refused(volume, tmp_path):
    cine = write(tmp_path / "cine.dcm", header(CINE, US_MULTI_FRAME))
    other = tmp_path / "a.nrrd"
    sitk.WriteImage(sitk.Image([4, 4, 4], sitk.sitkUInt8), str(other))
    before = other.read_bytes()
    (tmp_path / "empty").mkdir()
    for files, out, message in (
        ([volume, other], "o.nrrd", "no DICOM"),
        ([tmp_path / "empty"], "o.nrrd", "no DICOM"),
        ([tmp_path / "nowhere.dcm"], "o.nrrd", "no such file"),
        ([volume], "a.nrrd", r"a\.nrrd"),
        ([volume], "a.stl", r"a\.stl"),
        ([volume], "/proc/nowhere/a.nrrd", r"cannot be (written|made)"),
        ([cine], "case", "4 images"),
        ([cine], "o.nii.gz", "4 images"),
    ):
        with pytest.raises(UsSimError, match=message):
            plan_import(files, tmp_path / out, WHOLE).write()
    assert other.read_bytes() == before
    names = ["DOE_JANE.dcm", "a.nrrd", "cine.dcm", "empty"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
