"""Imports: their results, their refusals, their ends, and text that is burned in."""

import numpy as np
import pytest
import SimpleITK as sitk
from made_dicom import US_MULTI_FRAME, enhanced, header, item, turned, write

from us_sim.command.main import main
from us_sim.errors import UsSimError, VolumeError
from us_sim.volume.cases.case import read_case
from us_sim.volume.deidentification.importing import look_at
from us_sim.volume.deidentification.settings import ImportSettings
from us_sim.volume.files.readers import read_volume
from us_sim.volume.sequences.sequence import read_sequence

VOXELS = np.random.default_rng(5).integers(0, 256, (30, 24, 5), dtype=np.uint8)
CINE = np.random.default_rng(3).integers(0, 256, (4, 60, 80), dtype=np.uint8)
WHOLE = ImportSettings(keep_whole_image=True)


@pytest.fixture
def volume(tmp_path):
    return write(tmp_path / "DOE_JANE.dcm", enhanced(VOXELS, turned()))


def write_cine(path):
    made = header(CINE, US_MULTI_FRAME, FrameTime=40.0, FrameIncrementPointer=0x00181063)
    made.PixelSpacing = [0.2, 0.2]
    return write(path, made)


@pytest.fixture
def cine(tmp_path):
    return write_cine(tmp_path / "DOE_JANE.dcm")


def test_a_volume_becomes_a_case_that_can_be_opened(volume, tmp_path, capsys):
    assert main(["import", str(volume), "--out", str(tmp_path / "arm")]) == 0
    assert "30 × 24 × 5 voxels of 0.5 × 0.25 × 2 mm" in capsys.readouterr().out
    case = read_case(tmp_path / "arm")
    assert case.settings.name == "arm"
    np.testing.assert_array_equal(case.volume().intensities, VOXELS)
    np.testing.assert_allclose(case.placement()[0], read_volume(volume).index_to_patient, atol=1e-9)


def test_a_crop_leaves_every_voxel_where_it_was(volume, tmp_path):
    look_at([volume], tmp_path / "a.nrrd", ImportSettings(crop="3,2,20,15")).write()
    part, whole = read_volume(tmp_path / "a.nrrd"), read_volume(volume)
    assert part.shape == (18, 14, 5)
    np.testing.assert_array_equal(part.intensities, VOXELS[3:21, 2:16])
    at = whole.patient_to_index @ part.index_to_patient @ [1, 1, 1, 1]
    np.testing.assert_allclose(at, [4, 3, 1, 1], atol=1e-9)


def test_a_cine_becomes_images_with_their_times(cine, tmp_path):
    out = tmp_path / "cine.igs.mha"
    look_at([cine], out, ImportSettings(crop="10,5,69,54")).write()
    sweep = read_sequence(out)
    np.testing.assert_allclose(sweep.times, [0.0, 0.04, 0.08, 0.12])
    np.testing.assert_array_equal(np.array(list(sweep.images())), CINE[:, 5:55, 10:70])


def test_without_regions_a_person_decides(cine, tmp_path, capsys):
    out = tmp_path / "out" / "cine.igs.mha"
    out.parent.mkdir()
    assert main(["import", str(cine), "--out", str(out)]) == 1
    assert "--crop X0,Y0,X1,Y1" in capsys.readouterr().err
    assert not list(out.parent.iterdir())
    assert main(["import", str(cine), "--out", str(out), "--keep-whole-image"]) == 0


@pytest.mark.parametrize(
    ("edges", "kind", "doubt"),
    [
        ((0, 0, 90, 59), (1, 1), "90, 59.*80 × 60"),
        ((0, 0, None, 59), (1, 1), "0, 0, -1"),
        ((0, 0, 79, 59), (3, 3), "no ultrasound region"),
    ],
)
def test_regions_that_cannot_be_true_are_not_believed(tmp_path, edges, kind, doubt):
    keys = [f"RegionLocation{key}" for key in ("MinX0", "MinY0", "MaxX1", "MaxY1")]
    stated = {key: edge for key, edge in zip(keys, edges, strict=True) if edge is not None}
    region = item(RegionSpatialFormat=kind[0], RegionDataType=kind[1], **stated)
    made = header(CINE, US_MULTI_FRAME, SequenceOfUltrasoundRegions=[region])
    with pytest.raises(VolumeError, match=doubt):
        look_at([write(tmp_path / "a.dcm", made)], tmp_path / "a.igs.mha", ImportSettings()).write()


@pytest.mark.parametrize(
    ("values", "size"),
    [
        ({"PixelSpacing": [0.2, 0.25]}, (0.25, 0.2)),
        ({"NominalScannedPixelSpacing": [0.2, 0.25]}, (0.25, 0.2)),
        ({"PixelAspectRatio": [4, 5]}, None),
        ({}, None),
    ],
)
def test_the_size_of_pixels_is_what_the_header_or_a_person_says(tmp_path, values, size):
    out = tmp_path / "a.mha"
    path = write(tmp_path / "a.dcm", header(CINE, US_MULTI_FRAME, **values))
    given = ImportSettings(keep_whole_image=True, spacing="0.3,0.4")
    without, with_it = (WHOLE, given) if size else (given, WHOLE)
    with pytest.raises(VolumeError, match="--spacing"):
        look_at([path], out, with_it).write()
    look_at([path], out, without).write()
    assert sitk.ReadImage(str(out)).GetSpacing()[:2] == (size or (0.3, 0.4))


REGIONS = {"two_scales": {"184,75,491,554": 0.0616, "492,75,799,554": 0.1232}}
REGIONS["second_without_units"] = {"184,75,491,554": 0.0616}


@pytest.mark.parametrize("name", REGIONS)
def test_a_crop_has_the_scale_of_its_region_and_shows_nothing_outside(shared_file, tmp_path, name):
    path, out = shared_file(f"cases/dicom-two-scales/{name}.dcm"), tmp_path / "o.mha"
    for crop, message in (
        ("", "--crop 184,75,491,554"),
        ("400,75,600,554", "--crop 184,75,491,554"),
        ("0,0,100,60", "nothing of the ultrasound regions"),
        ("492,75,799,554", "--spacing"),
    ):
        if crop not in REGIONS[name]:
            with pytest.raises(VolumeError, match=message):
                look_at(
                    [path], out, ImportSettings(crop=crop) if crop else ImportSettings()
                ).write()
    with pytest.raises(VolumeError, match="--crop 184,75,491,554"):
        look_at([path], out, WHOLE).write()
    for crop, scale in REGIONS[name].items():
        out = tmp_path / f"{crop}.mha"
        look_at([path], out, ImportSettings(crop=crop)).write()
        assert sitk.ReadImage(str(out)).GetSpacing()[:2] == pytest.approx((scale, scale), rel=1e-4)
    look_at([path], tmp_path / "o.mha", ImportSettings(crop="100,0,450,500")).write()
    (image,) = read_sequence(tmp_path / "o.mha").images()
    assert not image[:75].any()
    assert not image[:, :84].any()
    assert image[75:, 84:].any()


def test_images_with_places_and_a_persons_spacing_are_a_volume(shared_file, tmp_path):
    folder = shared_file("cases/dicom-single-images") / "slicer_us_without_pixel_spacing"
    for spacing, message in (
        (None, r"states where its images lie.*--spacing"),
        ("0.21239,0.21239,1", r"0\.21239 mm apart"),
    ):
        with pytest.raises(VolumeError, match=message):
            look_at([folder], tmp_path / "o.nrrd", ImportSettings(spacing=spacing)).write()
    given = ImportSettings(spacing="0.21239,0.21239,0.21239")
    look_at([folder], tmp_path / "o.nrrd", given).write()
    made = read_volume(tmp_path / "o.nrrd")
    assert made.shape == (64, 128, 16)
    steps = np.linalg.norm(made.index_to_patient[:3, :3], axis=0)
    np.testing.assert_allclose(steps, 0.21239e-3, rtol=1e-6)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--spacing", "0"], "two or three numbers"),
        (["--spacing", "1,1,1"], "2D images"),
        (["--crop", "0,0,80,59"], "79"),
        (["--crop", "5,5,4,9"], "rectangle"),
    ],
)
def test_wrong_options_are_refused(cine, tmp_path, more, message, capsys):
    assert main(["import", str(cine), "--out", str(tmp_path / "o.igs.mha"), *more]) == 1
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1
    assert list(tmp_path.iterdir()) == [cine]


def test_files_and_outputs_that_do_not_fit_are_refused(volume, tmp_path):
    cine_too = write_cine(tmp_path / "cine.dcm")
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
        ([cine_too], "case", "4 images"),
        ([cine_too], "o.nii.gz", "4 images"),
    ):
        with pytest.raises(UsSimError, match=message):
            look_at(files, tmp_path / out, WHOLE).write()
    assert other.read_bytes() == before
    names = ["DOE_JANE.dcm", "a.nrrd", "cine.dcm", "empty"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
