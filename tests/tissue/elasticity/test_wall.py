"""The modulus of the wall against crushing, by its laws."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tissue_block import block_mesh

from us_sim.tissue.elasticity.wall import wall_modulus

MESH = block_mesh((4, 3, 3))
COUNT = len(MESH.tetrahedra)

shears = st.lists(st.floats(1.0, 1e9), min_size=COUNT, max_size=COUNT).map(np.array)


def wall(shear):
    return wall_modulus(MESH.tetrahedra, shear, len(MESH.nodes))


@pytest.mark.parametrize("shear", [1.0, 3e3, 1e12])
def test_in_uniform_tissue_it_is_five_shear_moduli(shear):
    np.testing.assert_allclose(wall(np.full(COUNT, shear)), 5 * shear, rtol=1e-14)


def test_a_stiff_tetrahedron_firms_those_that_share_a_node_with_it_and_no_others():
    shear = np.full(COUNT, 100.0)
    shear[3] = 1e6
    expected = np.full(COUNT, 500.0)
    for i, nodes in enumerate(MESH.tetrahedra):
        if set(nodes) & set(MESH.tetrahedra[3]):
            expected[i] = 5e4  # 5 times the mean, 1e4
    expected[3] = 5e6
    assert 0 < (expected == 500).sum() < COUNT - 2
    np.testing.assert_allclose(wall(shear), expected, rtol=1e-14)


@given(shears)
def test_it_is_never_below_the_tissues_own_nor_above_the_stiffest(shear):
    modulus = wall(shear)
    assert (modulus >= 5 * shear * (1 - 1e-14)).all()
    assert (modulus <= 5 * shear.max() * (1 + 1e-14)).all()


@given(shears, st.floats(1e-3, 1e3), st.randoms(use_true_random=False))
def test_it_scales_with_the_moduli_and_does_not_know_the_tetrahedras_order(shear, factor, random):
    np.testing.assert_allclose(wall(factor * shear), factor * wall(shear), rtol=1e-12)
    order = list(range(COUNT))
    random.shuffle(order)
    shuffled = wall_modulus(MESH.tetrahedra[order], shear[order], len(MESH.nodes))
    np.testing.assert_array_equal(shuffled, wall(shear)[order])
