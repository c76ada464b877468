"""The upper arm: its anatomy in numbers, its echoes, and the same bytes every time."""

import numpy as np
import pytest

from us_sim.errors import VolumeError
from us_sim.volume.measure import label_area
from us_sim.volume.phantom.phantom import cached_phantom, upper_arm
from us_sim.volume.phantom.upper_arm import UPPER_ARM_BLOCK, UPPER_ARM_LABELS, UpperArm
from us_sim.volume.volume import Volume

COARSE = 0.8e-3


@pytest.fixture(scope="module")
def arm() -> Volume:
    return upper_arm(seed=1, voxel_size=COARSE)


@pytest.fixture(scope="module")
def section():
    x, z = np.arange(-36e-3, 36e-3, 0.1e-3), np.arange(0.05e-3, 54e-3, 0.1e-3)
    return UpperArm(seed=1).section(x, 0.0, z)


def _centre(section, label):
    i, k = np.nonzero(section.labels == UPPER_ARM_LABELS[label])
    return section.x[i].mean(), section.z[k].mean()


def test_the_volume_covers_the_block_with_the_skin_at_z_0(arm):
    assert arm.extent[0][2] == pytest.approx(0.0, abs=1e-12)
    assert (arm.extent[0] <= UPPER_ARM_BLOCK[0] + 1e-9).all()
    assert (arm.extent[1] >= UPPER_ARM_BLOCK[1] - 1e-9).all()
    assert (arm.extent[1] < UPPER_ARM_BLOCK[1] + COARSE).all()
    np.testing.assert_allclose(np.diag(arm.index_to_patient)[:3], COARSE)


def test_every_structure_has_its_label(arm):
    assert arm.label_names == {n: name for name, n in UPPER_ARM_LABELS.items()}
    assert set(np.unique(arm.labels)) == set(arm.label_names)
    assert (arm.labels[:, :, 0] == UPPER_ARM_LABELS["skin"]).all()


def test_default_voxels_are_three_tenths_of_a_millimetre():
    assert upper_arm.__defaults__[1] == 0.3e-3
    assert cached_phantom.__defaults__[1] == 0.3e-3


def test_structures_lie_and_measure_as_in_an_arm(section):
    area = {
        name: label_area(section.labels, number, 0.1e-3**2)
        for name, number in UPPER_ARM_LABELS.items()
    }
    # Ellipses of 4.5 × 4.5, 7 × 5.5 and 4.8 × 3.8 mm, each within its 4 % of size.
    assert area["artery"] == pytest.approx(np.pi / 4 * 4.5e-3**2, rel=0.1)
    assert area["vein"] == pytest.approx(np.pi / 4 * 7e-3 * 5.5e-3, rel=0.1)
    assert area["nerve"] == pytest.approx(np.pi / 4 * 4.8e-3 * 3.8e-3, rel=0.1)
    assert area["bone"] == pytest.approx(np.pi / 4 * 21e-3 * 19.6e-3, rel=0.12)
    assert area["skin"] / 72e-3 == pytest.approx(1.8e-3, abs=0.15e-3)
    assert area["fat"] / 72e-3 == pytest.approx(5.2e-3, abs=0.8e-3)
    artery, vein = _centre(section, "artery"), _centre(section, "vein")
    assert artery == pytest.approx((-6e-3, 15e-3), abs=1.5e-3)
    assert vein[0] - artery[0] == pytest.approx(8e-3, abs=1e-3)
    assert vein[1] == pytest.approx(13e-3, abs=1.5e-3)
    assert _centre(section, "bone") == pytest.approx((12e-3, 38e-3), abs=1.5e-3)


def test_vessels_run_along_the_arm_within_two_millimetres(arm):
    for name in ("artery", "vein"):
        inside = arm.labels == UPPER_ARM_LABELS[name]
        assert inside.any(axis=(0, 2)).all()
        i = np.arange(arm.shape[0])[:, None]
        middle = (inside.sum(axis=2).T * i.T).sum(axis=1) / inside.sum(axis=(0, 2)) * COARSE
        assert np.ptp(middle) < 2.5e-3
        assert np.abs(np.diff(middle)).max() < 0.5e-3


@pytest.mark.parametrize("seed", [0, 2, 3, 99])
def test_structures_of_any_seed_keep_apart(seed):
    arm = UpperArm(seed)
    x, z = np.arange(-20e-3, 25e-3, 0.1e-3), np.arange(5e-3, 50e-3, 0.1e-3)
    for y in (-0.03, 0.0, 0.03):
        walls = [t.distance(x, y, z) for t in (arm.artery, arm.vein, arm.nerve, arm.humerus)]
        nearest = np.sort(walls, axis=0)
        assert (nearest[0] + nearest[1]).min() > 0.2e-3


def test_another_seed_moves_and_redraws(arm):
    other = upper_arm(seed=2, voxel_size=COARSE)
    assert (other.labels != arm.labels).any()
    assert (other.intensities != arm.intensities).mean() > 0.5
    # By half a millimetre, not to another arm.
    assert (other.labels != arm.labels).mean() < 0.06


def test_the_same_seed_gives_the_same_bytes(arm):
    again = upper_arm(seed=1, voxel_size=COARSE)
    assert again.intensities.tobytes() == arm.intensities.tobytes()
    assert again.labels.tobytes() == arm.labels.tobytes()


def test_another_voxel_size_shows_the_same_anatomy(arm):
    coarser = upper_arm(seed=1, voxel_size=1.6e-3)
    for number in UPPER_ARM_LABELS.values():
        fine = np.count_nonzero(arm.labels == number) * COARSE**3
        assert np.count_nonzero(coarser.labels == number) * 1.6e-3**3 == pytest.approx(
            fine, rel=0.15
        )


def test_tissues_echo_as_a_sonographer_expects(arm):
    grey = {
        name: float(arm.intensities[arm.labels == number].mean())
        for name, number in UPPER_ARM_LABELS.items()
    }
    assert grey["skin"] > grey["nerve"] > grey["fat"] > grey["muscle"] > 50
    assert grey["muscle"] - max(grey["vein"], grey["artery"]) > 20


def test_the_volume_knows_nothing_of_where_a_probe_is(arm):
    """No shadow behind the bone, and nothing that is brighter where it faces the skin."""
    middle = UpperArm(seed=1).humerus.middle(0.0)
    i, j, _, _ = np.rint(arm.patient_to_index @ [middle[0], 0.0, 0.0, 1.0]).astype(int)
    column = (slice(i - 3, i + 4), slice(j - 10, j + 11))
    bone = arm.labels[column] == UPPER_ARM_LABELS["bone"]
    muscle = arm.labels[column] == UPPER_ARM_LABELS["muscle"]
    depth = np.arange(arm.shape[2])
    first = int(depth[bone.any(axis=(0, 1))].min())
    behind = muscle & (depth > first)
    assert behind.any()
    before = arm.intensities[column][muscle & (depth < first)].mean()
    assert arm.intensities[column][behind].mean() == pytest.approx(before, abs=15)
    surface = arm.intensities[column][:, :, first - 1 : first + 2].mean()
    assert surface < before + 15


def test_muscle_behind_a_vein_scatters_as_that_beside_it():
    arm = UpperArm(seed=1)
    x, z = np.arange(-20e-3, 20e-3, 0.2e-3), np.arange(0.1e-3, 30e-3, 0.2e-3)
    behind, beside = [], []
    for y in np.linspace(-0.03, 0.03, 13):
        section = arm.section(x, float(y), z)
        middle = arm.vein.middle(float(y))[0]
        deep = (z > 19e-3) & (z < 24e-3)
        behind.append((section.diffuse[np.abs(x - middle) < 1e-3][:, deep] ** 2).mean())
        beside.append((section.diffuse[np.abs(x - middle - 9e-3) < 1e-3][:, deep] ** 2).mean())
    assert 10 * np.log10(np.mean(behind) / np.mean(beside)) == pytest.approx(0.0, abs=2.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"seed": -1}, "seed of a phantom: -1 is outside"),
        ({"voxel_size": 0.1e-3}, "0.0001 m is outside 0.0002 to 0.005 m"),
        ({"voxel_size": 0.01}, "0.01 m is outside"),
        ({"voxel_size": float("nan")}, "nan is not finite"),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    with pytest.raises(VolumeError, match=message):
        upper_arm(**arguments)
