"""A stylus' tip from poses about a fixed point: known tips, noise, outliers and refusals.

Clustered covariance against what is known of it exactly: HC2, and its expectation.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import curve_fit
from scipy.spatial.transform import Rotation

from us_sim.errors import CalibrationError
from us_sim.geometry.pose import Pose
from us_sim.tracking.calibration.pivot import calibrate_pivot, cluster_numbers, clustered_covariance

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


def fitted(design, observed):
    """Residuals (N, D) of least squares with a design (N, D, P)."""
    flat = design.reshape(-1, design.shape[2])
    solution = np.linalg.lstsq(flat, observed.ravel(), rcond=None)[0]
    return observed - design @ solution


def test_clusters_of_one_number_are_the_estimate_of_mackinnon_and_white():
    # HC2 (MacKinnon and White 1985): squared residuals over one less their leverage.
    rng = np.random.default_rng(0)
    design, observed = rng.standard_normal((30, 1, 3)), rng.standard_normal((30, 1))
    flat, residuals = design[:, 0], fitted(design, observed)
    inverse = np.linalg.inv(flat.T @ flat)
    leverage = np.einsum("ni,ij,nj->n", flat, inverse, flat)
    meat = (flat.T * (residuals[:, 0] ** 2 / (1.0 - leverage))) @ flat
    found = clustered_covariance(design, residuals, np.arange(30))
    np.testing.assert_allclose(found, inverse @ meat @ inverse, rtol=1e-12)


@settings(max_examples=5, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), clusters=st.integers(3, 8))
def test_errors_that_are_independent_are_neither_under_nor_overestimated(seed, clusters):
    # The estimate is a sum of squares of errors, so errors of one number each add up to its mean.
    rng = np.random.default_rng(seed)
    design = rng.standard_normal((24, 2, 3))
    of = np.concatenate([np.arange(clusters), rng.integers(0, clusters, 24 - clusters)])
    total = sum(
        clustered_covariance(design, fitted(design, unit.reshape(24, 2)), of) for unit in np.eye(48)
    )
    flat = design.reshape(-1, 3)
    np.testing.assert_allclose(total, np.linalg.inv(flat.T @ flat), rtol=1e-9, atol=1e-12)


def test_a_parameter_of_one_cluster_alone_does_not_disturb_the_others():
    # Each cluster has a level of its own: what is left is the slope within clusters.
    rng = np.random.default_rng(3)
    of = np.repeat(np.arange(8), 6)
    slope, noise = rng.standard_normal(48), rng.standard_normal(48)
    levels = (of[:, None] == np.arange(8)).astype(float)
    design = np.column_stack([slope, levels])[:, None]
    centred = slope - (levels @ (levels.T @ slope)) / 6
    all_of_them = clustered_covariance(design, fitted(design, noise[:, None]), of)
    without = centred[:, None, None]
    centred_noise = (noise - (levels @ (levels.T @ noise)) / 6)[:, None]
    alone = clustered_covariance(without, fitted(without, centred_noise), of)
    assert all_of_them[0, 0] == pytest.approx(alone[0, 0], rel=1e-9)


def test_few_features_are_divided_into_runs_and_many_are_not():
    many = [f"wire {k % 9}" for k in range(90)]
    assert cluster_numbers(many).max() == 8
    np.testing.assert_array_equal(cluster_numbers(many)[:9], cluster_numbers(many)[9:18])
    pin = cluster_numbers(["pin"] * 60)
    np.testing.assert_array_equal(pin, np.repeat(np.arange(12), 5))
    three = cluster_numbers(["a", "b", "c"] * 8)
    np.testing.assert_array_equal(three[::3], np.repeat(np.arange(4), 2))
    assert len(set(three)) == 12
