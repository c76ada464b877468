"""Dense and compressed fields against products of matrices, and the laws of superposition."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.tissue.linear_algebra.compliance import DenseFields
from us_sim.tissue.linear_algebra.low_rank_fields import LowRankFields


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 150), st.sampled_from([np.float32, np.float64]))
def test_a_sum_is_the_product_with_the_forces(seed, surface, precision):
    random = np.random.default_rng(seed)
    exact = random.normal(size=(40, 3, 3 * surface))
    nodes = random.permutation(40)[:33]
    made = DenseFields.compute(
        nodes,
        surface,
        lambda chosen: exact.reshape(40, 3, -1, 3)[:, :, chosen].reshape(40, 3, -1),
        precision,
    )
    forces = random.normal(size=3 * surface) * (random.random(3 * surface) < 0.5)
    displacement = np.ones((40, 3))
    made.add(forces, displacement)
    expected = np.ones((40, 3))
    expected[nodes] += exact[nodes] @ forces
    np.testing.assert_allclose(displacement, expected, atol=1e-4)


SURFACE = 150
TOLERANCE = 1e-4


def kelvin(points, sources):
    """(N, 3, 3K), of point forces in an infinite solid (Kelvin's solution), blunted at a source."""
    away = points[:, None] - points[sources]
    near = 1 / np.sqrt(0.02**2 + (away**2).sum(axis=-1))
    field = np.einsum("nk,ab->nakb", 1.8 * near, np.eye(3))
    field += np.einsum("nk,nka,nkb->nakb", near**3, away, away)
    return field.reshape(len(points), 3, -1)


@pytest.fixture(scope="module")
def points():
    """Some in a cube; the first of them on its top."""
    found = np.random.default_rng(0).random((1500, 3))
    found[:SURFACE, 2] = 0.0
    return found


@pytest.fixture(scope="module")
def made(points):
    nodes = np.arange(20, len(points))  # those before are held
    return LowRankFields.compress(
        points, nodes, points[:SURFACE], lambda chosen: kelvin(points, chosen), TOLERANCE
    )


def moved(made, forces):
    displacement = np.zeros((1500, 3))
    made.add(forces, displacement)
    return displacement


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, SURFACE), st.booleans())
def test_any_forces_move_as_in_full(points, made, seed, count, together):
    random = np.random.default_rng(seed)
    if together:
        distance = np.linalg.norm(points[:SURFACE] - points[random.integers(SURFACE)], axis=1)
        chosen = np.argsort(distance)[:count]
    else:
        chosen = random.permutation(SURFACE)[:count]
    forces = np.zeros((SURFACE, 3))
    forces[chosen] = random.normal(size=(count, 3))
    found = moved(made, forces.ravel())
    full = kelvin(points, np.arange(SURFACE))
    error = found - full @ forces.ravel()
    error[:20] = found[:20]
    largest = abs(full).max(axis=(0, 1))
    # Each block may be off by the tolerance for each of the few patches that are loaded.
    assert np.linalg.norm(error, axis=1).max() <= 3 * TOLERANCE * np.linalg.norm(
        largest * forces.ravel()
    )


@pytest.mark.slow
def test_what_is_far_takes_little_place(points):
    """Forces on one side, nodes ten times as far away as both are wide: a few vectors do."""
    far = points + np.where(np.arange(len(points))[:, None] < SURFACE, 0.0, 10.0)
    nodes = np.arange(SURFACE, len(far))
    made = LowRankFields.compress(
        far, nodes, far[:SURFACE], lambda chosen: kelvin(far, chosen), TOLERANCE
    )
    assert made.minor.size + made.major.size + made.right.size < 0.1 * 9 * SURFACE * len(nodes)
    assert (np.diff(made.patches, axis=1) == SURFACE).all()  # one patch for each block
