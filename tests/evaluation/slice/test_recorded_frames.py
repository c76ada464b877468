"""Images cut from the real liver volume beside the real frames, and made-up sweeps."""

import csv
import math

import cv2
import numpy as np
import pytest
import SimpleITK as sitk

from us_sim.errors import VolumeError
from us_sim.evaluation.slice.recorded import (
    LIVER_SWEEP,
    RecordedFan,
    compare_with_recorded,
    normalised_cross_correlation,
)
from us_sim.slicing.cutting.resampling import sample_plane
from us_sim.slicing.probe.plane import SlicePlane
from us_sim.volume.files.readers import read_volume
from us_sim.volume.sequences.sweep import read_sweep

SPACING = 0.314818e-3


@pytest.fixture(scope="module")
def liver(shared_data):
    """The volume's file and the sweep's."""
    folder = shared_data / "imfusion-liver-sweep"
    files = folder / "liver_sweep_compounded_1mm.mha", folder / "liver_sweep.igs.mha"
    for file in files:
        if not file.exists():
            pytest.skip(f"no {file}")
    return files


@pytest.mark.slow
def test_real_frames_are_found_again_in_the_volume(liver, tmp_path):
    found = compare_with_recorded(*liver, tmp_path, quick=True)
    with (tmp_path / "recorded_frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["frame"]) for row in rows] == list(range(0, 140, 10))
    for row in rows:
        assert float(row["ncc_raw"]) >= 0.8, row
        assert float(row["ncc_smoothed"]) >= float(row["ncc_raw"]), row
        assert float(row["coverage"]) >= 0.85, row
        # The wrong way round must not reach it, or the number would say nothing.
        assert float(row["ncc_mirrored"]) < 0.8, row
        assert int(row["grey_difference_rigid"]) <= 1, row
    assert np.abs(found.shifts).max() < 1e-3  # m, the volume's voxel
    picture = cv2.imread(str(tmp_path / "recorded_frames.png"))
    assert picture.shape[1] > picture.shape[0] > 500
    text = found.markdown()
    assert "Data: ImFusion GmbH, CC BY 4.0" in text
    assert "14 of 14" in text


def test_the_fan_is_where_the_real_frames_are_lit(liver):
    brightest = np.max(list(read_sweep(liver[1]).images(range(0, 140, 5))), axis=0)
    row, column = np.mgrid[: brightest.shape[0], : brightest.shape[1]]
    x, z = column - LIVER_SWEEP.column, row - LIVER_SWEEP.row + LIVER_SWEEP.radius
    way = np.hypot(x, z) - LIVER_SWEEP.radius  # pixels, from the face
    beyond = (np.abs(np.arctan2(x, z)) - LIVER_SWEEP.half_angle) * (way + LIVER_SWEEP.radius)
    # The face and the sides are sharp to two pixels; deep down the recording is dark itself.
    assert (brightest[(way > 0) & (way < 60) & (beyond < -2)] > 16).mean() > 0.98
    assert (brightest[(way < -2) | (beyond > 2)] > 16).mean() < 0.001
    # The ends of the face lie in the first row: its sagitta is the row of its middle.
    sagitta = LIVER_SWEEP.radius * (1 - math.cos(LIVER_SWEEP.half_angle))
    assert sagitta == pytest.approx(LIVER_SWEEP.row, abs=0.01)
    probe = LIVER_SWEEP.probe(SPACING)
    assert probe.depth == pytest.approx(563.01 * SPACING)


def test_normalised_cross_correlation_is_pearsons():
    random = np.random.Generator(np.random.PCG64(3))
    a, b = random.normal(size=(2, 30, 20))
    where = random.random((30, 20)) < 0.5
    expected = np.corrcoef(a[where], b[where])[0, 1]
    assert normalised_cross_correlation(a, b, where) == pytest.approx(expected, abs=1e-12)
    assert math.isnan(normalised_cross_correlation(a, np.ones_like(a), where))
    assert math.isnan(normalised_cross_correlation(a, b, np.zeros_like(where)))


SMALL = RecordedFan(column=40.0, row=5.0, radius=30.0, end=80.0, half_angle=math.radians(25))


def _made_up(tmp_path, columns=81, rows=60, shift=0.0, spacing=(1.0, 1.0)):
    """A random volume of 1 mm voxels and a sweep of three frames cut from it, as files."""
    random = np.random.Generator(np.random.PCG64(8))
    grey = cv2.GaussianBlur(random.random((90, 100, 90)).reshape(90, -1), (0, 0), 1.5)
    grey = cv2.normalize(grey, None, 1, 255, cv2.NORM_MINMAX).reshape(90, 100, 90)
    image = sitk.GetImageFromArray(grey.astype(np.uint8))
    sitk.WriteImage(image, str(tmp_path / "volume.mha"))
    volume = read_volume(tmp_path / "volume.mha")
    header = (
        f"ObjectType = Image\nNDims = 3\nDimSize = {columns} {rows} 3\nElementType = MET_UCHAR\n"
    )
    frames = b""
    for k in range(3):
        matrix = np.eye(4)
        matrix[:3, 0], matrix[:3, 1], matrix[:3, 2] = (
            (spacing[0], 0, 0),
            (0, 0, spacing[1]),
            (0, -1, 0),
        )
        matrix[:3, 3] = (5.0, 40.0 + 3 * k, 10.0)
        metres = matrix[:3] * 1e-3
        plane = SlicePlane(metres[:, 3], metres[:, 0], metres[:, 1], columns, rows)
        frames += sample_plane(volume, plane).tobytes()
        matrix[0, 3] += shift
        numbers = " ".join(f"{number:g}" for number in matrix.ravel())
        header += f"Seq_Frame{k:04d}_ImageToReferenceTransform = {numbers}\n"
        header += f"Seq_Frame{k:04d}_Timestamp = {k / 10}\n"
    path = tmp_path / "sweep.igs.mha"
    path.write_bytes(header.encode() + b"ElementDataFile = LOCAL\n" + frames)
    return tmp_path / "volume.mha", path


def test_frames_cut_from_the_volume_correlate_fully(tmp_path):
    found = compare_with_recorded(*_made_up(tmp_path), tmp_path / "out", quick=False, fan=SMALL)
    assert [row.frame for row in found.rows] == [0, 1, 2]
    assert found.lowest > 0.98  # but for the probe's pixels, which are not quite the frame's
    np.testing.assert_array_equal(found.shifts, 0.0)


@pytest.mark.slow
def test_a_wrong_pose_shows_as_a_shift(tmp_path):
    files = _made_up(tmp_path, shift=1.0)
    found = compare_with_recorded(*files, tmp_path / "out", quick=False, fan=SMALL)
    # The poses lie 1 mm too far along +x: the cut should move by -1 mm.
    np.testing.assert_allclose(found.shifts, [[-1e-3, 0.0, 0.0]] * 3, atol=1e-9)


@pytest.mark.parametrize(
    ("made", "fan", "message"),
    [
        ({}, LIVER_SWEEP, "81 × 60 pixels do not hold the probe's fan"),
        ({"shift": 500.0}, SMALL, "the volume covers nothing of frame 0"),
        ({"spacing": (1.0, 0.9)}, SMALL, "pixels are not squares of one size"),
    ],
)
def test_a_sweep_that_is_not_the_volumes_is_refused(tmp_path, made, fan, message):
    files = _made_up(tmp_path, **made)
    with pytest.raises(VolumeError, match=message) as refused:
        compare_with_recorded(*files, tmp_path / "out", quick=False, fan=fan)
    assert "\n" not in str(refused.value)
