"""Where to start: a pose that was scanned from, or above the middle of what was."""

from dataclasses import replace

import numpy as np
import pytest

from us_sim.errors import CaseError
from us_sim.geometry.pose import Placement, Pose
from us_sim.geometry.transducer import ProbeSettings
from us_sim.settings.choice import ChosenOption
from us_sim.settings.registry import PROBES
from us_sim.volume.cases.proposal import complete_settings, move_to_skin
from us_sim.volume.cases.settings import CaseSettings, CaseStart, CaseStructure
from us_sim.volume.volume import Volume

linear = PROBES.load_settings("linear")
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
    plain = complete_settings(CaseSettings("a", scanned=poses), volume)
    assert plain.start.proposed
    assert plain.start.position == (0.0, 0.0, 0.01)
    seen = complete_settings(CaseSettings("a", scanned=poses, structures=VEIN), volume)
    assert seen.start.position == (0.0, 0.0, 0.01)  # it slides by 8 mm, and the vein is midway
    far = tuple(Placement((0.0, p.position[1] + 0.02, 0.01)) for p in poses)
    moved = complete_settings(CaseSettings("a", scanned=far, structures=VEIN), volume)
    assert moved.start.position == (0.0, 0.004, 0.01)  # the first that is not the sweep's end
    said = CaseStart((0.01, 0.0, 0.0))
    fixed = CaseSettings("a", start=said, scanned=poses, structures=VEIN)
    assert complete_settings(fixed, volume).start == said


def test_without_poses_a_linear_array_looks_along_the_columns_of_the_images():
    made = complete_settings(CaseSettings("a"), scanned_block())
    pose, array = made.start.pose, made.probe.array.given
    np.testing.assert_allclose(pose.position, [-0.001, -0.001, 0.010], atol=1e-3)
    np.testing.assert_allclose(pose.rotation[:, [0, 2]], np.eye(3)[:, [0, 2]], atol=1e-9)
    assert made.probe.geometry == "linear"
    assert made.probe.collider.name == "rounded_box"
    assert (array.aperture, array.depth) == pytest.approx((0.038, 0.048), abs=3e-3)


def curved_block(bend: float) -> Volume:
    """60 mm wide, 50 mm deep and 40 mm of elevation; skin 20 mm below its top where x is -10 mm.

    Args:
        bend: m, by which the skin is deeper 20 mm aside; negative is higher.
    """
    grid = np.zeros((4, 4))
    grid[0, 0] = grid[2, 1] = grid[1, 2] = 1e-3
    grid[:3, 3] = (-0.03, -0.02, 0.0)
    grid[3, 3] = 1.0
    x, depth = 1e-3 * np.arange(60) - 0.03, 1e-3 * np.arange(50)
    skin = 0.02 + bend * ((x + 0.01) / 0.02) ** 2
    grey = np.where(depth[None, :] >= skin[:, None], 90, 0).astype(np.uint8)
    grey[20:40:5, 3] = 60  # specks
    return Volume(np.repeat(grey[:, :, None], 40, axis=2), grid)


def skin_under(start: Placement, volume: Volume, half: float) -> float:
    """mm, how far below the face (negative: above) the skin is where it is nearest."""
    x = np.linspace(-half, half, 51)
    nearest = []
    for depth in np.arange(-0.03, 0.03, 2e-4):
        points = start.pose.transform_points(np.column_stack([x, 0 * x, 0 * x + depth]))
        index = np.rint(points @ volume.patient_to_index[:3, :3].T + volume.patient_to_index[:3, 3])
        kept = ((index >= 0) & (index < volume.shape)).all(axis=1)
        seen = volume.intensities[tuple(index[kept].astype(int).T)] == 90
        if seen.any():
            nearest.append(depth)
    return 1e3 * min(nearest)


@pytest.mark.parametrize("bend", [0.0, 0.004, 0.01, -0.008])
def test_the_face_touches_skin_that_is_curved(bend):
    volume = curved_block(bend)
    probe = ProbeSettings(ChosenOption("linear", linear(aperture=0.03, depth=0.03)))
    for said in ({}, {"probe": probe}):
        made = complete_settings(CaseSettings("a", **said), volume)
        half = made.probe.array.given.aperture / 2
        assert skin_under(made.start, volume, half) == pytest.approx(0.0, abs=1.0)  # a voxel


@pytest.mark.parametrize("depth", [0.010, 0.026])
def test_a_pose_above_or_inside_is_put_on_the_skin_along_its_own_axis(depth):
    turn = Pose(orientation=[-np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])  # its z is the volume's y
    volume = curved_block(0.0)
    volume = replace(volume, index_to_patient=turn.matrix @ volume.index_to_patient)
    start = turn @ Pose([0.0, 0.0, depth])
    moved = move_to_skin(Placement(tuple(start.position), tuple(start.orientation)), volume, None)
    np.testing.assert_allclose(
        moved.position, turn.transform_points(np.array([[0, 0, 0.0195]]))[0], atol=5e-4
    )


def test_where_nothing_was_scanned_nothing_is_proposed():
    black = Volume(np.zeros((4, 4, 4), np.uint8), np.diag([1e-3, 1e-3, 1e-3, 1.0]))
    with pytest.raises(CaseError, match="are 0"):
        complete_settings(CaseSettings("a"), black)
