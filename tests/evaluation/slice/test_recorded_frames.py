"""Images cut from the real liver volume beside the real frames, and made-up sweeps."""

import math

import cv2
import numpy as np
import pytest
import SimpleITK as sitk

from us_sim.errors import VolumeError
from us_sim.evaluation.slice.recorded import (
    LIVER_SWEEP,
    RecordedFan,
    normalised_cross_correlation,
    recorded_rows,
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
def test_real_frames_are_found_again_in_the_volume(liver):
    rows = list(recorded_rows(*liver, quick=True))
    assert [row["frame"] for row in rows] == list(range(0, 140, 10))
    for row in rows:
        assert row["ncc_raw"] >= 0.8, row
        assert row["ncc_smoothed"] >= row["ncc_raw"], row
        assert row["coverage"] >= 0.85, row
        # The wrong way round must not reach it, or the number would say nothing.
        assert row["ncc_mirrored"] < 0.8, row
        assert row["grey_difference_rigid"] <= 1, row


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


@pytest.mark.slow
def test_frames_cut_from_the_volume_correlate_fully(tmp_path):
    rows = list(recorded_rows(*_made_up(tmp_path), quick=False, fan=SMALL))
    assert [row["frame"] for row in rows] == [0, 1, 2]
    # But for the probe's pixels, which are not quite the frame's.
    assert min(row["ncc_raw"] for row in rows) > 0.98


@pytest.mark.slow
@pytest.mark.parametrize(
    ("made", "fan", "message"),
    [
        ({}, LIVER_SWEEP, "fan"),
        ({"shift": 500.0}, SMALL, "covers nothing of frame 0"),
        ({"spacing": (1.0, 0.9)}, SMALL, "not squares"),
    ],
)
def test_a_sweep_that_is_not_the_volumes_is_refused(tmp_path, made, fan, message):
    with pytest.raises(VolumeError, match=message):
        list(recorded_rows(*_made_up(tmp_path, **made), quick=False, fan=fan))
