"""The One-Euro filter against the paper's scalar one, and its lag against the one it states."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.geometry import se3
from us_sim.geometry.pose import Pose
from us_sim.tracking.filter.one_euro import OneEuro
from us_sim.tracking.filter.settings import OneEuroSettings
from us_sim.tracking.measurement import Measurement


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


def run(one_euro, times, poses):
    return [
        one_euro.update(Measurement(round(1e9 * t), pose)).pose
        for t, pose in zip(times, poses, strict=True)
    ]


def delay(times, signal, frequency):
    """s, up to half a period: where the cross correlation with sin(2 pi f t) is largest."""
    delays = np.linspace(-0.49, 0.49, 98_001) / frequency
    ahead = 2 * np.pi * frequency
    sine, cosine = signal @ np.sin(ahead * times), signal @ np.cos(ahead * times)
    return delays[np.argmax(np.cos(ahead * delays) * sine - np.sin(ahead * delays) * cosine)]


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
        Pose(w * direction, se3.product(se3.rotation_exp(t * axis), start.orientation))
        for w, t in zip(way, turn, strict=True)
    ]
    filtered = run(OneEuro(SETTINGS), times, poses)
    expected = scalar_one_euro(times, way, 1.2, 30.0, 1.5)
    np.testing.assert_allclose([p.position @ direction for p in filtered], expected, atol=1e-9)
    turned = [se3.rotation_between(start.orientation, p.orientation) @ axis for p in filtered]
    np.testing.assert_allclose(turned, scalar_one_euro(times, turn, 0.8, 4.0, 1.5), atol=1e-9)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_it_does_not_matter_how_the_frame_lies(seed):
    rng = np.random.default_rng(seed)
    frame = Pose(rng.normal(size=3), rng.normal(size=4))
    times = np.cumsum(rng.uniform(0.005, 0.03, 20))
    poses = [Pose(rng.normal(0, 0.1, 3), [*rng.normal(0, 0.2, 3), 1.0]) for _ in times]
    here = run(OneEuro(SETTINGS), times, poses)
    there = run(OneEuro(SETTINGS), times, [frame @ pose for pose in poses])
    for a, b in zip(here, there, strict=True):
        np.testing.assert_allclose((frame @ a).matrix, b.matrix, atol=1e-9)


@pytest.mark.parametrize("rate", [30.0, 200.0, 1000.0])
@pytest.mark.parametrize(("speed", "turning"), [(0.02, 0.1), (0.3, 2.0)])
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
    assert turned / turning == pytest.approx(one_euro.rotation_lag, rel=1e-3)
    assert one_euro.rotation_lag == pytest.approx(1 / (2 * np.pi * (0.8 + 4.0 * turning)), rel=1e-3)


@pytest.mark.parametrize("rate", [30.0, 500.0])
@pytest.mark.parametrize("frequency", [0.25, 1.0, 3.0])
def test_behind_a_sway_by_the_stated_lag(rate, frequency):
    one_euro = OneEuro(OneEuroSettings(minimum_cutoff=3.0, speed_coefficient=0.0))
    times = np.arange(round(12 * rate)) / rate
    poses = [Pose([0.01 * math.sin(2 * math.pi * frequency * t), 0, 0]) for t in times]
    out = np.array([p.position[0] for p in run(one_euro, times, poses)])
    late = times >= 4.0  # 8 s: whole periods
    measured = delay(times[late], out[late], frequency)
    assert measured == pytest.approx(one_euro.lag_at(frequency), rel=0.01, abs=2e-5)
    if frequency == 0.25:
        assert measured == pytest.approx(one_euro.lag, rel=0.02)


def test_at_rest_noise_shrinks_as_that_of_exponential_smoothing():
    """Its variance by a / (2 - a), with the share a = 1 / (1 + 1 / (2 pi fc T))."""
    rng = np.random.default_rng(3)
    times = np.arange(20_000) / 100.0
    noise = rng.normal(0, 1e-4, len(times))
    one_euro = OneEuro(OneEuroSettings(minimum_cutoff=2.0, speed_coefficient=0.0))
    out = np.array([p.position[0] for p in run(one_euro, times, [Pose([n, 0, 0]) for n in noise])])
    share = 1 / (1 + 100 / (2 * np.pi * 2.0))
    assert out[100:].var() / noise.var() == pytest.approx(share / (2 - share), rel=0.05)


def test_a_sweep_is_hardly_delayed_with_the_defaults():
    one_euro = OneEuro(OneEuroSettings())
    assert one_euro.lag == pytest.approx(0.106, abs=1e-3)  # at rest: 1 / (2 pi 1.5 Hz)
    for k in range(300):
        one_euro.update(Measurement(k * 10_000_000, Pose([0.1 * 0.01 * k, 0, 0])))
    assert one_euro.lag == pytest.approx(0.0082, abs=1e-4)


def test_after_a_reset_the_next_pose_is_the_first():
    one_euro = OneEuro(SETTINGS)
    for k in range(10):
        one_euro.update(Measurement(k * 10_000_000, Pose([0.1 * k, 0, 0])))
    one_euro.reset()
    seen = Measurement(5, Pose([-1.0, 2.0, 3.0], [1.0, 0, 0, 0]))
    assert one_euro.update(seen).pose is seen.pose
    assert one_euro.lag == pytest.approx(1 / (2 * np.pi * 1.2))
