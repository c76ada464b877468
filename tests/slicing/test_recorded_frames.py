"""Images cut from the real liver volume beside the real frames that it was made from.

This tests the whole path from a pose to an image on real data: the probe's geometry, the frames and
their units, the slicer. It does not say how well an unseen image would be foretold.
"""

import math

import cv2
import liver_sweep
import numpy as np
import pytest

from us_sim.slicing.cutting.resampling import sample_plane
from us_sim.slicing.cutting.slicer import create_slicer
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
from us_sim.volume.files.readers import read_volume
from us_sim.volume.sequences.sweep import read_sweep
from us_sim.volume.volume import Volume


@pytest.fixture(scope="module")
def liver(shared_data):
    """The volume's file and the sweep's."""
    folder = shared_data / "imfusion-liver-sweep"
    files = folder / "liver_sweep_compounded_1mm.mha", folder / "liver_sweep.igs.mha"
    for file in files:
        if not file.exists():
            pytest.skip(f"no {file}")
    return files


def correlation(one, other, where):
    return np.corrcoef(one[where].astype(float), other[where].astype(float))[0, 1]


@pytest.mark.slow
def test_real_frames_are_found_again_in_the_volume(liver):
    volume, sweep = read_volume(liver[0]), read_sweep(liver[1])
    covered = np.where(volume.intensities > 0, np.uint8(255), np.uint8(0))
    support = Volume(covered, volume.index_to_patient)
    sides = zip(*volume.extent, (24, 20, 16), strict=True)
    mesh = box_mesh(*(uniform_planes(a, b, n) for a, b, n in sides))
    slicer = create_slicer("scan_conversion", volume, mesh.nodes, mesh.tetrahedra)
    probe = liver_sweep.probe()
    # Within 2 mm of the border of the swept region few frames were averaged.
    width = 2 * round(2e-3 / liver_sweep.SPACING) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width))
    chosen = range(0, len(sweep.numbers), 10)
    for index, image in zip(chosen, sweep.read_images(chosen), strict=True):
        plane = probe.make_plane(liver_sweep.probe_pose(sweep.image_to_reference[index]))
        recorded, simulated = (
            liver_sweep.on_probe_pixels(image, probe),
            slicer.cut_image(mesh.nodes, plane),
        )
        seen = ((sample_plane(support, plane) == 255) & plane.make_shown_mask()).astype(np.uint8)
        border = {"borderType": cv2.BORDER_CONSTANT, "borderValue": 0}
        compared = cv2.erode(seen, disc, **border).astype(bool)
        smoothed = cv2.GaussianBlur(recorded.astype(np.float32), (0, 0), 1e-3 / liver_sweep.SPACING)
        assert compared.sum() / plane.make_shown_mask().sum() > 0.85
        alike = correlation(recorded, simulated, compared)
        assert 0.8 < alike < correlation(smoothed, simulated, compared)
        # The wrong way round must not reach it, or the number would say nothing.
        both = compared & compared[:, ::-1]
        assert correlation(smoothed, simulated[:, ::-1], both) < 0.8
        rigid = np.where(plane.make_shown_mask(), sample_plane(volume, plane), np.uint8(0))
        assert np.abs(simulated.astype(int) - rigid).max() <= 1


def test_the_fan_is_where_the_real_frames_are_lit(liver):
    brightest = np.max(list(read_sweep(liver[1]).read_images(range(0, 140, 5))), axis=0)
    row, column = np.mgrid[: brightest.shape[0], : brightest.shape[1]]
    x, z = column - liver_sweep.COLUMN, row - liver_sweep.ROW + liver_sweep.RADIUS
    way = np.hypot(x, z) - liver_sweep.RADIUS  # pixels, from the face
    beyond = (np.abs(np.arctan2(x, z)) - liver_sweep.HALF_ANGLE) * (way + liver_sweep.RADIUS)
    # The face and the sides are sharp to two pixels; deep down the recording is dark itself.
    assert (brightest[(way > 0) & (way < 60) & (beyond < -2)] > 16).mean() > 0.98
    assert (brightest[(way < -2) | (beyond > 2)] > 16).mean() < 0.001
    # The ends of the face lie in the first row: its sagitta is the row of its middle.
    sagitta = liver_sweep.RADIUS * (1 - math.cos(liver_sweep.HALF_ANGLE))
    assert sagitta == pytest.approx(liver_sweep.ROW, abs=0.01)
    assert liver_sweep.probe().depth == pytest.approx(563.01 * liver_sweep.SPACING)
