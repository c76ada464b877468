"""Clustered covariance against what is known of it exactly: HC2, and its expectation."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.tracking.calibration.clustered_covariance import cluster_numbers, clustered_covariance


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
