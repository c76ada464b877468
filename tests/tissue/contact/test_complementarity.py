"""Unilateral contact against its own definition, and against enumeration of all active sets."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.tissue.contact.complementarity import solve_unilateral


def enumerated(delassus, gap):
    """The solution by trying every set of pushed nodes."""
    for chosen in itertools.product([False, True], repeat=len(gap)):
        active = np.array(chosen)
        push = np.zeros(len(gap))
        push[active] = np.linalg.solve(delassus[np.ix_(active, active)], -gap[active])
        if (push >= -1e-12).all() and (delassus @ push + gap >= -1e-12).all():
            return push
    raise AssertionError("a positive definite problem has a solution")


@pytest.mark.parametrize("seed", range(5))
def test_agrees_with_enumeration(seed):
    random = np.random.default_rng(seed)
    root = random.normal(size=(7, 7))
    delassus = root @ root.T + 0.1 * np.eye(7)
    gap = random.normal(size=7)
    push, active = solve_unilateral(delassus, gap, random.random(7) < 0.5)
    np.testing.assert_allclose(push, enumerated(delassus, gap), atol=1e-9)
    np.testing.assert_array_equal(active, push > 0)


@settings(max_examples=150, deadline=None)
@given(st.integers(1, 25), st.integers(1, 30), st.integers(0, 2**32 - 1))
def test_gaps_and_pushes_are_complementary_even_with_redundant_rows(count, rank, seed):
    random = np.random.default_rng(seed)
    root = random.normal(size=(count, rank)) * 10.0 ** random.uniform(-3, 3)
    delassus = root @ root.T
    gap = -delassus @ np.maximum(random.normal(size=count), 0)
    gap += (random.random(count) < 0.5) * np.abs(gap).max() * random.random(count)
    push, active = solve_unilateral(delassus, gap, random.random(count) < 0.5)
    opened = delassus @ push + gap
    scale = max(np.abs(gap).max(), 1e-300)
    assert (push >= 0).all()
    assert (push[~active] == 0).all()
    assert opened.min() >= -1e-6 * scale
    assert np.abs(opened[active]).max(initial=0) <= 1e-6 * scale


def test_a_problem_that_takes_too_many_pivots_is_solved_by_relaxation():
    """Y. Fathi, Computational complexity of LCPs associated with positive definite symmetric
    matrices, Math. Programming 17 (1979): the least index first takes 2^n - 1 pivots.
    """
    count = 20
    root = np.tril(np.full((count, count), 2.0), -1) + np.eye(count)
    delassus = (root @ root.T)[::-1, ::-1]
    gap = -np.cumsum(2.0 ** np.arange(count, 0, -1))[::-1]
    force, active = solve_unilateral(delassus, gap, np.zeros(count, dtype=bool))
    # The node of the smallest gap carries all, and opens the others by more than they need.
    np.testing.assert_allclose(force, [*[0.0] * (count - 1), 2.0**count], rtol=1e-12)
    np.testing.assert_array_equal(active, force > 0.0)


def test_nobody_is_pushed_where_nothing_is_entered():
    push, active = solve_unilateral(np.eye(3), np.array([0.0, 1.0, 2.0]), np.ones(3, dtype=bool))
    assert not push.any()
    assert not active.any()
    assert solve_unilateral(np.empty((0, 0)), np.empty(0), np.empty(0, dtype=bool))[0].shape == (0,)
