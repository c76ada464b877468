"""Centre lines of tubes that are known, and planes that cut them."""

import numpy as np
import pytest

from us_sim.geometry.pose import Pose
from us_sim.scoring.centre_line import CentreLine
from us_sim.volume.volume import Volume

VOXEL = 0.5e-3
SHAPE = (60, 120, 60)
SLOPE = 0.25  # of x over y


@pytest.fixture(scope="module")
def tube():
    """4 mm in radius, 15 mm deep, 60 mm long in y; x is a quarter of y."""
    to_patient = np.diag([VOXEL, VOXEL, VOXEL, 1.0])
    to_patient[:3, 3] = [-0.015, -0.030, 0.0]
    x, y, z = (
        VOXEL * each + at for each, at in zip(np.indices(SHAPE), (-0.015, -0.030, 0.0), strict=True)
    )
    # the distance from the axis, which leads along (SLOPE, 1, 0)
    labels = np.hypot((x - SLOPE * y) / np.hypot(1, SLOPE), z - 0.015) < 0.004
    volume = Volume(np.zeros(SHAPE, np.uint8), to_patient, labels.astype(np.uint8), {1: "vein"})
    return volume, labels


def test_the_line_lies_in_the_middle_and_is_as_long_as_the_tube(tube):
    line = CentreLine.from_labels(*tube)
    inner = line.points[np.abs(line.points[:, 1]) < 0.025]
    assert np.abs(inner[:, 0] - SLOPE * inner[:, 1]).max() < 0.3e-3
    assert np.abs(inner[:, 2] - 0.015).max() < 0.3e-3
    assert line.lengths[-1] == pytest.approx(0.06 * np.hypot(1, SLOPE), abs=0.003)


@pytest.mark.parametrize("turn", [-30, 14.036])
def test_where_a_turned_plane_cuts_it(tube, turn):
    line = CentreLine.from_labels(*tube)
    half = np.deg2rad(turn) / 2
    pose = Pose([SLOPE * 0.01, 0.01, 0.0], [0, 0, np.sin(half), np.cos(half)])
    along, _ = line.find_cut(pose, 0.04)
    found = line.interpolate_point(along)
    assert found == pytest.approx([SLOPE * 0.01, 0.01, 0.015], abs=0.4e-3)
    other = Pose([SLOPE * -0.01, -0.01, 0.0], [0, 0, np.sin(half), np.cos(half)])
    assert along - line.find_cut(other, 0.04)[0] == pytest.approx(
        0.02 * np.hypot(1, SLOPE), abs=0.5e-3
    )


def test_a_plane_beside_the_vessel_or_above_it_cuts_nothing(tube):
    line = CentreLine.from_labels(*tube)
    assert line.find_cut(Pose([0.03, 0.0, 0.0]), 0.04) is None
    assert line.find_cut(Pose([0.0, 0.05, 0.0]), 0.04) is None
    assert line.find_cut(Pose([0.0, 0.0, 0.03]), 0.04) is None
