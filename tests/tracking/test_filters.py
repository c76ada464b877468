"""The One-Euro filter against the paper's scalar one, and its lag against the one it states.

The Kalman filter against the linear textbook one, its own statistics, and its stated lag.
"""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from us_sim.geometry import se3
from us_sim.geometry.pose import Pose
from us_sim.tracking.filters import ConstantVelocityKalman, OneEuro
from us_sim.tracking.measurement import Measurement
from us_sim.tracking.settings import KalmanSettings, OneEuroSettings


def scalar_one_euro(times, values, minimum, beta, derivative_cutoff):
    """Casiez, Roussel, Vogel (2012), algorithm 1 and equations 2 to 6, of one number."""

    def alpha(cutoff, period):
        tau = 1 / (2 * math.pi * cutoff)
        return 1 / (1 + tau / period)

    filtered, speed = [values[0]], 0.0
    for k in range(1, len(values)):
        period = times[k] - times[k - 1]
        share = alpha(derivative_cutoff, period)
        speed = share * (values[k] - values[k - 1]) / period + (1 - share) * speed
        share = alpha(minimum + beta * abs(speed), period)
        filtered.append(share * values[k] + (1 - share) * filtered[-1])
    return np.array(filtered)


def run(pose_filter, times, poses):
    return [
        pose_filter.update(Measurement(round(1e9 * t), pose)).pose
        for t, pose in zip(times, poses, strict=True)
    ]


SETTINGS = OneEuroSettings(
    minimum_cutoff=1.2,
    speed_coefficient=30.0,
    rotation_minimum_cutoff=0.8,
    rotation_speed_coefficient=4.0,
    derivative_cutoff=1.5,
)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_along_an_axis_it_is_the_papers_scalar_filter(seed):
    rng = np.random.default_rng(seed)
    times = 1e-9 * np.round(1e9 * np.cumsum(rng.uniform(0.002, 0.05, 60)))
    way, turn = (np.cumsum(rng.normal(0, s, 60)) for s in (0.01, 0.05))
    axis, direction = rng.normal(size=(2, 3))
    axis, direction = axis / np.linalg.norm(axis), direction / np.linalg.norm(direction)
    start = Pose(orientation=rng.normal(size=4))
    poses = [
        Pose(w * direction, se3.multiply_quaternions(se3.rotation_exp(t * axis), start.orientation))
        for w, t in zip(way, turn, strict=True)
    ]
    filtered = run(OneEuro(SETTINGS), times, poses)
    expected = scalar_one_euro(times, way, 1.2, 30.0, 1.5)
    np.testing.assert_allclose([p.position @ direction for p in filtered], expected, atol=1e-9)
    turned = [se3.rotation_between(start.orientation, p.orientation) @ axis for p in filtered]
    np.testing.assert_allclose(turned, scalar_one_euro(times, turn, 0.8, 4.0, 1.5), atol=1e-9)


@pytest.mark.parametrize(
    ("rate", "speed", "turning"), [(30.0, 0.3, 2.0), (200.0, 0.02, 0.1), (1000.0, 0.3, 2.0)]
)
def test_behind_a_uniform_motion_by_the_stated_lag(rate, speed, turning):
    times = np.arange(round(4 * rate)) / rate
    one_euro = OneEuro(SETTINGS)
    poses = [
        Pose([speed * t, 0, 0], se3.rotation_exp(np.array([0, 0, turning * t]))) for t in times
    ]
    last = run(one_euro, times, poses)[-1]
    behind = (poses[-1].position[0] - last.position[0]) / speed
    assert behind == pytest.approx(one_euro.lag, rel=1e-3)
    assert one_euro.lag == pytest.approx(1 / (2 * np.pi * (1.2 + 30.0 * speed)), rel=1e-3)
    turned = se3.rotation_between(last.orientation, poses[-1].orientation)[2]
    assert turned / turning == pytest.approx(1 / (2 * np.pi * (0.8 + 4.0 * turning)), rel=1e-3)


ACCELERATION, ANGULAR_ACCELERATION = 0.7, 6.0
KALMAN = KalmanSettings(
    acceleration=ACCELERATION,
    angular_acceleration=ANGULAR_ACCELERATION,
    position_deviation=4e-4,
    rotation_deviation=6e-3,
)
INITIAL_SPEED, INITIAL_ANGULAR_SPEED = 0.5, 5.0  # one standard deviation that it begins with


def linear_kalman(times, points, noises):
    """Position and its covariance: constant velocity in three dimensions, in textbook form.

    Bar-Shalom, Li, Kirubarajan (2001), section 5.2 with the model of 6.2.2.
    """
    state = np.r_[points[0], np.zeros(3)]
    covariance = np.zeros((6, 6))
    covariance[:3, :3], covariance[3:, 3:] = noises[0], INITIAL_SPEED**2 * np.eye(3)
    observed = np.c_[np.eye(3), np.zeros((3, 3))]
    answers = [(state[:3], covariance[:3, :3])]
    for k in range(1, len(times)):
        step = times[k] - times[k - 1]
        moved = np.kron([[1, step], [0, 1]], np.eye(3))
        driven = np.kron([[step**3 / 3, step**2 / 2], [step**2 / 2, step]], np.eye(3))
        state = moved @ state
        covariance = moved @ covariance @ moved.T + ACCELERATION**2 * driven
        innovation = observed @ covariance @ observed.T + noises[k]
        gain = covariance @ observed.T @ np.linalg.inv(innovation)
        state = state + gain @ (points[k] - observed @ state)
        covariance = (np.eye(6) - gain @ observed) @ covariance
        answers.append((state[:3], covariance[:3, :3]))
    return answers


def random_covariance(rng, position=4e-4, rotation=6e-3):
    """(6, 6), with correlations."""
    root = np.diag([position] * 3 + [rotation] * 3) @ rng.normal(size=(6, 6)) * 0.5
    return root @ root.T + np.diag([0.01 * position**2] * 3 + [0.01 * rotation**2] * 3)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_without_rotation_it_is_the_linear_filter(seed, told):
    """With the measurements' own covariances, whatever the steps; else with the settings'."""
    rng = np.random.default_rng(seed)
    stamps = np.cumsum(rng.integers(1_000_000, 80_000_000, 40))
    points = np.cumsum(rng.normal(0, 2e-3, (40, 3)), axis=0)
    covariances = np.zeros((40, 6, 6))
    for k in range(40):
        covariances[k] = np.diag([4e-4**2] * 3 + [6e-3**2] * 3)
        if told:
            covariances[k, :3, :3] = random_covariance(rng)[:3, :3]
    kalman = ConstantVelocityKalman(KALMAN)
    expected = linear_kalman(1e-9 * stamps, points, covariances[:, :3, :3])
    for k, (position, covariance) in enumerate(expected):
        seen = Measurement(int(stamps[k]), Pose(points[k]), covariances[k] if told else None)
        filtered = kalman.update(seen)
        np.testing.assert_allclose(filtered.pose.position, position, atol=1e-12)
        np.testing.assert_allclose(filtered.covariance[:3, :3], covariance, rtol=1e-6, atol=1e-16)
        np.testing.assert_allclose(filtered.pose.orientation, [0, 0, 0, 1], atol=1e-15)


class Walk:
    """A body driven by just the white accelerations that the filter's settings claim."""

    def __init__(self, rng):
        self._rng = rng
        self.stamp = 1_000_000_000
        self.pose = Pose(rng.normal(0, 0.1, 3), rng.normal(size=4))
        scale = np.r_[np.full(3, INITIAL_SPEED), np.full(3, INITIAL_ANGULAR_SPEED)]
        self.velocity = rng.normal(0, scale)
        self._density = np.r_[np.full(3, ACCELERATION), np.full(3, ANGULAR_ACCELERATION)]

    def go(self, nanoseconds):
        step = 1e-9 * nanoseconds
        root = np.linalg.cholesky([[step**3 / 3, step**2 / 2], [step**2 / 2, step]])
        moved, faster = (root @ self._rng.normal(size=(2, 6))) * self._density
        way = step * self.velocity + moved
        self.pose = displaced(self.pose, way)
        self.velocity = self.velocity + faster
        self.stamp += nanoseconds

    def measured(self):
        covariance = random_covariance(self._rng)
        noise = np.linalg.cholesky(covariance) @ self._rng.normal(size=6)
        return Measurement(self.stamp, displaced(self.pose, noise), covariance)


def displaced(pose, way):
    """A pose displaced (6,) as a measurement's covariance means it."""
    return Pose(
        pose.position + way[:3],
        se3.multiply_quaternions(se3.rotation_exp(way[3:]), pose.orientation),
    )


def difference(pose, other):
    turn = se3.rotation_between(pose.orientation, other.orientation)
    return np.r_[other.position - pose.position, turn]


@pytest.mark.slow
def test_it_errs_as_much_as_it_says():
    """NEES over runs and NIS over all steps, in the chi-square's middle 99.8 per cent."""
    rng = np.random.default_rng(11)
    runs, steps = 120, 30
    errors, innovations = 0.0, 0.0
    for _ in range(runs):
        walk, kalman = Walk(rng), ConstantVelocityKalman(KALMAN)
        kalman.update(walk.measured())
        for _ in range(steps):
            walk.go(int(rng.integers(3_000_000, 50_000_000)))
            seen = walk.measured()
            place, covariance = kalman.predict_pose(seen.stamp)
            innovation = difference(Pose(*place), seen.pose)
            covariance = covariance[:6, :6] + seen.covariance
            innovations += innovation @ np.linalg.solve(covariance, innovation)
            filtered = kalman.update(seen)
        error = difference(filtered.pose, walk.pose)
        errors += error @ np.linalg.solve(filtered.covariance, error)
    for total, freedom in ((errors, 6 * runs), (innovations, 6 * runs * steps)):
        low, high = chi2.ppf([0.001, 0.999], freedom)
        assert low < total < high


def test_errors_go_on_as_the_predicted_pose_says_by_differences():
    """Turning by 1.5 rad within the step, where the rotation's errors turn too."""
    rng = np.random.default_rng(9)
    quiet = KalmanSettings(acceleration=1e-6, angular_acceleration=1e-6)
    stamps, step = (0, 10**9, 11 * 10**8, 18 * 10**8), 1e-6  # ns: two measured, two predicted
    start = Pose(rng.normal(size=3), rng.normal(size=4))
    covariances = [random_covariance(rng, 0.1, 0.1), random_covariance(rng, 0.01, 0.01)]
    way = np.array([0.1, -0.2, 0.3, 1.1, -1.3, 0.8])

    def measured(error):
        kalman = ConstantVelocityKalman(quiet)
        poses = displaced(start, error[:6]), displaced(displaced(start, way), error[6:])
        for stamp, pose, covariance in zip(stamps, poses, covariances, strict=False):
            kalman.update(Measurement(stamp, pose, covariance))
        return kalman, *(Pose(*kalman.predict_pose(stamp)[0]) for stamp in stamps[1:])

    now, later = np.zeros((12, 12)), np.zeros((6, 12))
    for k, error in enumerate(step * np.eye(12)):
        behind, ahead = (measured(sign * error)[1:] for sign in (-1, 1))
        now[:6, k] = difference(behind[0], ahead[0])
        now[6:, k] = (difference(*ahead[:2]) - difference(*behind[:2])) / 0.1  # of the velocity
        later[:, k] = difference(behind[2], ahead[2])
    kalman = measured(np.zeros(12))[0]
    transition = np.eye(12)
    transition[:6] = later @ np.linalg.inv(now)
    expected = transition @ kalman.predict_pose(stamps[1])[1] @ transition.T
    np.testing.assert_allclose(kalman.predict_pose(stamps[3])[1], expected, atol=1e-9)


def test_not_behind_a_uniform_motion():
    kalman = ConstantVelocityKalman(KALMAN)
    speed, turning = np.array([0.1, -0.05, 0.02]), np.array([0.3, 1.0, -0.4])
    times = np.arange(90) / 30.0
    poses = [Pose(time * speed, se3.rotation_exp(time * turning)) for time in times]
    behind = difference(run(kalman, times, poses)[-1], poses[-1])
    assert kalman.lag == 0.0
    assert np.linalg.norm(behind[:3]) / np.linalg.norm(speed) < 1e-6  # s
    assert np.linalg.norm(behind[3:]) / np.linalg.norm(turning) < 1e-6
