"""Where to start is found from what was scanned: on fans that are known, and on a real liver."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from us_sim.geometry.pose import Placement, Pose
from us_sim.volume.cases.proposal import ScannedRegion, with_proposal
from us_sim.volume.cases.settings import CaseSettings, CaseStart, CaseStructure
from us_sim.volume.files.readers import read_volume
from us_sim.volume.volume import Volume


def scanned_by(pose: Pose, labels=None) -> Volume:
    """3 mm voxels of what a curved array scans: 60°, radius 50 mm, 120 mm deep, 50 mm thick.

    Grey values fall from 150 at the face by 6 for each centimetre.
    """
    grid = np.diag([3e-3, 3e-3, 3e-3, 1.0])
    grid[:3, 3] = -0.15
    i = np.indices((100, 100, 100)).reshape(3, -1).T
    x, y, z = ((i * 3e-3 - 0.15 - pose.position) @ pose.rotation).T
    radius, angle = np.hypot(x, z + 0.05), np.arctan2(x, z + 0.05)
    fan = (abs(radius - 0.11) < 0.06) & (abs(angle) < np.pi / 6) & (abs(y) < 0.025)
    grey = (fan * np.clip(150 - 600 * (radius - 0.05), 20, 255)).astype(np.uint8)
    grey = grey.reshape(100, 100, 100)
    if labels is None:
        return Volume(grey, grid)
    return Volume(grey, grid, labels(x, y, z).astype(np.uint8).reshape(grey.shape))


@pytest.mark.parametrize("turn", [[0.0, 0.0, 0.0], [1.2, -0.4, 0.3]])
def test_the_probe_that_scanned_a_fan_is_found(turn):
    true = Pose(np.array([0.01, -0.02, 0.0]), Rotation.from_rotvec(turn).as_quat())
    true = true @ Pose(np.array([0.0, 0.0, -0.06]))  # so that the fan is inside
    volume = scanned_by(true)
    region = ScannedRegion(volume)
    off = true.inverse() @ region.middle_pose()
    assert np.linalg.norm(off.position) < 9e-3  # three voxels
    assert np.degrees(np.arccos(off.rotation[2, 2])) < 6.0
    assert abs(off.rotation[0, 0]) > 0.98  # along the array, from whichever end
    probe = region.probe_at(region.middle_pose())
    assert probe.geometry == "convex"
    assert probe.array.given.depth == pytest.approx(0.12, abs=9e-3)


def test_the_start_moves_to_the_structures_and_not_to_layers():
    true = Pose(np.array([0.0, 0.0, -0.06]))

    def vessel(x, y, z):
        return 3 * (np.hypot(x, z - 0.07) < 0.01) * (abs(y - 0.014) < 7e-3)

    volume = scanned_by(true, vessel)
    plain = with_proposal(CaseSettings("a"), volume)
    muscle = with_proposal(CaseSettings("a", structures={"muscle": CaseStructure(3)}), volume)
    vein = with_proposal(CaseSettings("a", structures={"vein": CaseStructure(3)}), volume)
    assert muscle.start == plain.start
    before, after = (
        (true.inverse() @ case.start.pose).apply(np.zeros((1, 3)))[0] for case in (plain, vein)
    )
    assert abs(before[1]) < 5e-3
    assert 4e-3 < after[1] < 18e-3  # it slides by 8 mm from there
    assert abs(after[2]) < 5e-3  # on the skin
    said = CaseStart((0.01, 0.0, 0.0))
    fixed = CaseSettings("a", start=said, structures={"vein": CaseStructure(3)})
    assert with_proposal(fixed, volume).start == said


def test_the_probe_of_a_real_sweep_is_found_from_its_volume_alone(shared_data):
    file = shared_data / "imfusion-liver-sweep" / "liver_sweep_compounded_1mm.mha"
    volume = read_volume(file)
    region = ScannedRegion(volume)
    # The middle pose of the sweep that the volume was made of (config/scenes/liver_sweep.yaml).
    middle = Pose(
        np.array([49.435e-3, 92.014e-3, 127.456e-3]),
        np.array([-0.792792, 0.12626, -0.013698, -0.596113]),
    )
    off = middle @ region.middle_pose()
    assert np.linalg.norm(off.position) < 6e-3
    assert np.degrees(np.arccos(off.rotation[2, 2])) < 5.0
    assert np.degrees(np.arccos(off.rotation[0, 0])) < 12.0
    probe = region.probe_at(region.middle_pose())
    assert probe.geometry == "convex"
    assert probe.array.given.depth == pytest.approx(0.177, abs=4e-3)


@pytest.mark.slow
def test_a_start_is_a_pose_that_was_scanned_where_these_are_known():
    def vessel(x, y, z):
        return 3 * (np.hypot(x, z - 0.07) < 0.01) * (abs(y - 0.004) < 5e-3)

    volume = scanned_by(Pose(np.array([0.0, 0.0, -0.06])), vessel)
    poses = tuple(
        Placement((0.0, y, -0.06), (0.0, 0.0, 0.0, 1.0)) for y in np.linspace(-0.02, 0.02, 11)
    )
    vein = {"vein": CaseStructure(3)}
    plain = with_proposal(CaseSettings("a", scanned=poses), volume)
    seen = with_proposal(CaseSettings("a", scanned=poses, structures=vein), volume)
    assert plain.start.proposed
    assert plain.start.position == (0.0, 0.0, -0.06)
    assert seen.start.position == (0.0, 0.0, -0.06)  # it slides by 8 mm, and the vein is midway
    far = tuple(Placement((0.0, p.position[1] + 0.02, -0.06)) for p in poses)
    moved = with_proposal(CaseSettings("a", scanned=far, structures=vein), volume)
    assert moved.start.position == (0.0, 0.004, -0.06)  # the first that is not the sweep's end
    said = CaseStart((0.01, 0.0, 0.0))
    fixed = CaseSettings("a", start=said, scanned=poses, structures=vein)
    assert with_proposal(fixed, volume).start == said


@pytest.mark.parametrize(
    ("ahead", "behind", "slide"),
    [(20, 2, 8), (5, 2, 5), (2, 20, -8)],
)
def test_the_press_slides_as_far_as_something_was_scanned(ahead, behind, slide):
    grid = np.diag([1e-3, 2.5e-4, 1e-3, 1.0])
    grid[:3, 3] = [-0.02, -0.025, 0.0]
    grey = np.zeros((41, 201, 31), np.uint8)
    y = np.arange(201) * 0.25 - 25
    grey[:, (y >= -behind) & (y <= ahead), :] = 90
    scanned = (Placement((0.0, 0.0, 0.0)),)
    made = with_proposal(CaseSettings("a", scanned=scanned), Volume(grey, grid))
    assert made.start.position == (0.0, 0.0, 0.0)
    assert made.slide == pytest.approx(1e-3 * slide, abs=1.01e-3)
    assert -behind <= 1e3 * made.slide <= ahead
    chosen = CaseSettings("a", start=CaseStart((0.0, 0.0, 0.0)), slide=0.003)
    assert with_proposal(chosen, Volume(grey, grid)).slide == 0.003
