"""Intervals hold the truth as often as they say, also where residuals are alike."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.tissue.identification.fit import blocks, covariance, jackknife, quantile

TIMES = np.repeat(np.arange(60.0), 3)
DEPTHS = np.repeat(np.sin(np.pi * (np.arange(60) + 0.5) / 60), 3)
DESIGN = np.column_stack([DEPTHS, DEPTHS**2, np.ones(180)])


@pytest.mark.parametrize("correlation", [0.0, 0.7])
def test_95_percent_intervals_hold_the_truth_in_95_of_100_runs(correlation):
    random = np.random.default_rng(4)
    inside, runs = 0, 400
    for _ in range(runs):
        noise = random.normal(size=(60, 3))
        for k in range(1, 60):
            noise[k] = correlation * noise[k - 1] + np.sqrt(1 - correlation**2) * noise[k]
        found, *_ = np.linalg.lstsq(DESIGN, noise.ravel(), rcond=None)
        residual = noise.ravel() - DESIGN @ found
        half = quantile(0.95) * np.sqrt(covariance(DESIGN, residual, TIMES, DEPTHS))
        inside += np.abs(found[0]) <= half[0]
    assert inside >= 0.93 * runs


def test_independent_residuals_have_the_classical_covariance():
    random = np.random.default_rng(5)
    design = random.normal(size=(4000, 3))
    residual = 0.3 * random.normal(size=4000)
    found = jackknife(design, residual, blocks(np.arange(4000.0), 200))
    assert np.diag(found) == pytest.approx(
        0.09 * np.diag(np.linalg.inv(design.T @ design)), rel=0.3
    )


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(0, 50), min_size=1, max_size=100), st.integers(1, 12))
def test_blocks_are_in_order_and_keep_equals_together(order, count):
    part = blocks(np.array(order, dtype=float), count)
    assert part.min() == 0
    assert part.max() < count
    for value in set(order):
        assert len({int(p) for p, v in zip(part, order, strict=True) if v == value}) == 1
    assert (np.diff(part[np.argsort(order, kind="stable")]) >= 0).all()
