"""Where to start: a pose that was scanned from, or above the middle of what was."""

import numpy as np
import pytest

from us_sim.errors import CaseError
from us_sim.geometry.pose import Placement
from us_sim.volume.cases.proposal import with_proposal
from us_sim.volume.cases.settings import CaseSettings, CaseStart, CaseStructure
from us_sim.volume.volume import Volume

VEIN = {"vein": CaseStructure(3)}


def scanned_block(vein_at: float = 0.004) -> Volume:
    """40 mm wide, 60 mm deep and 50 mm of elevation, in 2 mm voxels, with a vein across it.

    The second axis goes into the body, as in the images of a scanner.
    """
    grid = np.zeros((4, 4))
    grid[0, 0] = grid[2, 1] = grid[1, 2] = 2e-3
    grid[:3, 3] = (-0.02, -0.025, 0.0)
    grid[3, 3] = 1.0
    grey = np.full((20, 30, 25), 90, np.uint8)
    grey[:, :5] = 0  # never scanned
    labels = np.zeros_like(grey)
    y = (np.arange(25) * 2e-3) - 0.025
    labels[8:12, 15:18, np.abs(y - vein_at) < 5e-3] = 3
    return Volume(grey, grid, labels)


def test_a_start_is_a_pose_that_was_scanned_where_these_are_known():
    volume = scanned_block()
    poses = tuple(Placement((0.0, float(y), 0.01)) for y in np.linspace(-0.02, 0.02, 11))
    plain = with_proposal(CaseSettings("a", scanned=poses), volume)
    assert plain.start.proposed
    assert plain.start.position == (0.0, 0.0, 0.01)
    seen = with_proposal(CaseSettings("a", scanned=poses, structures=VEIN), volume)
    assert seen.start.position == (0.0, 0.0, 0.01)  # it slides by 8 mm, and the vein is midway
    far = tuple(Placement((0.0, p.position[1] + 0.02, 0.01)) for p in poses)
    moved = with_proposal(CaseSettings("a", scanned=far, structures=VEIN), volume)
    assert moved.start.position == (0.0, 0.004, 0.01)  # the first that is not the sweep's end
    said = CaseStart((0.01, 0.0, 0.0))
    fixed = CaseSettings("a", start=said, scanned=poses, structures=VEIN)
    assert with_proposal(fixed, volume).start == said


def test_without_poses_a_linear_array_looks_along_the_columns_of_the_images():
    made = with_proposal(CaseSettings("a"), scanned_block())
    pose, array = made.start.pose, made.probe.array.given
    np.testing.assert_allclose(pose.position, [-0.001, -0.001, 0.010], atol=1e-3)
    np.testing.assert_allclose(pose.rotation[:, [0, 2]], np.eye(3)[:, [0, 2]], atol=1e-9)
    assert made.probe.geometry == "linear"
    assert made.probe.collider.name == "rounded_box"
    assert (array.aperture, array.depth) == pytest.approx((0.038, 0.048), abs=3e-3)


def test_where_nothing_was_scanned_nothing_is_proposed():
    black = Volume(np.zeros((4, 4, 4), np.uint8), np.diag([1e-3, 1e-3, 1e-3, 1.0]))
    with pytest.raises(CaseError, match="are 0"):
        with_proposal(CaseSettings("a"), black)
