"""A stylus' tip from poses about a fixed point: known tips, noise, outliers and refusals."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import curve_fit
from scipy.spatial.transform import Rotation

from us_sim.errors import CalibrationError
from us_sim.geometry.pose import Pose
from us_sim.tracking.calibration.pivot import calibrate_pivot

TIP = np.array([0.0086, -0.0023, 0.1085])
HOLE = np.array([0.3, -0.1, 0.9])
coordinate = st.floats(-0.3, 0.3)


def pivoting(rotations, tip=TIP, hole=HOLE):
    """(K, 3) positions and orientations of a body whose tip stays in the hole."""
    return [Pose(hole - rotation.apply(tip), rotation.as_quat()) for rotation in rotations]


def shifted(pose, by):
    return Pose(pose.position + by, pose.orientation)


def tilts(rng, count, degrees=25.0):
    """Rotations about all axes, after one that no axis is special for."""
    turned = Rotation.from_rotvec(np.radians(degrees) * rng.standard_normal((count, 3)))
    return turned * Rotation.from_rotvec([0.4, 1.0, -0.3])


@settings(max_examples=25, deadline=None)
@given(
    tip=st.tuples(coordinate, coordinate, coordinate),
    hole=st.tuples(coordinate, coordinate, coordinate),
    seed=st.integers(0, 1000),
)
def test_exact_poses_give_the_tip_exactly(tip, hole, seed):
    tip, hole = np.array(tip), np.array(hole)
    poses = pivoting(tilts(np.random.default_rng(seed), 20), tip, hole)
    found = calibrate_pivot(poses)
    np.testing.assert_allclose(found.tip, tip, atol=1e-12)
    np.testing.assert_allclose(found.pivot, hole, atol=1e-12)
    assert found.rms < 1e-12
    assert found.rejected == 0


@pytest.mark.slow
def test_errors_are_as_large_as_the_deviations_say():
    rng = np.random.default_rng(4)
    noise = 0.3e-3
    errors = []
    for _ in range(120):
        poses = pivoting(tilts(rng, 60, 12.0))
        found = calibrate_pivot([shifted(pose, noise * rng.standard_normal(3)) for pose in poses])
        errors.append((found.tip - TIP) / found.deviations)
        assert found.rms == pytest.approx(noise * np.sqrt(3), rel=0.4)
    # 360 normal deviates: their root mean square is 1 with a standard deviation of 0.04.
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(1.0, abs=0.13)


@pytest.mark.parametrize("count", [10, 12, 30])
def test_deviations_are_those_of_a_fit_with_six_unknowns(count):
    """Three numbers a pose, less the six that are fitted, as scipy's fit counts them."""
    rng = np.random.default_rng(count)
    poses = [shifted(pose, 2e-4 * rng.uniform(-1, 1, 3)) for pose in pivoting(tilts(rng, count))]
    found = calibrate_pivot(poses)
    assert found.rejected == 0
    rotations = np.concatenate([pose.rotation for pose in poses])

    def positions(_, *unknown):
        return np.tile(unknown[3:], count) - rotations @ unknown[:3]

    seen = np.concatenate([pose.position for pose in poses])
    best, covariance = curve_fit(positions, None, seen, np.append(TIP, HOLE))
    np.testing.assert_allclose(found.tip, best[:3], atol=1e-9)
    np.testing.assert_allclose(found.deviations, np.sqrt(np.diag(covariance))[:3], rtol=1e-4)


def test_a_third_of_wrong_poses_is_left_out_and_counted():
    rng = np.random.default_rng(8)
    poses = [shifted(pose, 2e-4 * rng.standard_normal(3)) for pose in pivoting(tilts(rng, 90))]
    for k in range(0, 90, 3):
        poses[k] = shifted(poses[k], rng.uniform(0.01, 0.1, 3))
    found = calibrate_pivot(poses)
    assert 30 <= found.rejected <= 32
    assert not found.inliers[::3].any()
    np.testing.assert_allclose(found.tip, TIP, atol=2e-4)


SPUN = Rotation.from_euler("z", np.linspace(0, 5, 50)[:, None])  # about the stylus' own axis
ROCKED = Rotation.from_euler("x", np.linspace(-0.6, 0.6, 50)[:, None])  # in one plane, and shaken
SHAKEN = Rotation.from_rotvec(np.random.default_rng(1).normal(0, 1e-3, (50, 3)))


@pytest.mark.parametrize(
    ("rotations", "problem"),
    [
        (SPUN * Rotation.from_rotvec([0.4, 1, 0]), "one axis"),
        (ROCKED * SHAKEN, "one axis"),
        (Rotation.identity(30), "one axis"),
        (tilts(np.random.default_rng(0), 9), "10 poses, not 9"),
    ],
    ids=["spun", "rocked", "still", "too few"],
)
def test_poses_that_do_not_determine_the_tip_are_refused(rotations, problem):
    with pytest.raises(CalibrationError, match=problem):
        calibrate_pivot(pivoting(rotations))
