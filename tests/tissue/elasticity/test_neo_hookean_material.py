"""The modulus of the wall against crushing, by its laws."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tissue_block import block_mesh

from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import make_uniform_materials
from us_sim.tissue.elasticity.neo_hookean_material import barrier_modulus, barrier_strength

MESH = block_mesh((4, 3, 3))
COUNT = len(MESH.tetrahedra)

shears = st.lists(st.floats(1.0, 1e9), min_size=COUNT, max_size=COUNT).map(np.array)


def wall(shear):
    return barrier_modulus(MESH.tetrahedra, shear, len(MESH.nodes))


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


def withstood(shear):
    soft = make_uniform_materials(MESH, Material(3.0, 0.25, 1000.0))
    return barrier_strength(MESH, replace(soft, young_modulus=2.5 * shear))


def third_of_faces():
    """(M, 4) m2: by Heron's formula, a third of the face opposite each corner."""
    areas = np.empty((COUNT, 4))
    for t, corners in enumerate(MESH.tetrahedra):
        for i in range(4):
            a, b, c = MESH.nodes[np.delete(corners, i)]
            sides = [np.linalg.norm(a - b), np.linalg.norm(b - c), np.linalg.norm(c - a)]
            half = sum(sides) / 2
            areas[t, i] = np.sqrt(half * np.prod([half - side for side in sides])) / 3
    return areas


def test_in_uniform_tissue_a_node_withstands_shear_modulus_times_area():
    expected = np.zeros(len(MESH.nodes))
    np.add.at(expected, MESH.tetrahedra, 3e3 * third_of_faces())
    np.testing.assert_allclose(withstood(np.full(COUNT, 3e3)), expected, rtol=1e-12)


def test_a_stiff_tetrahedron_beside_soft_ones_counts_no_more_than_their_walls():
    shear = np.full(COUNT, 100.0)
    shear[3] = 1e6
    areas, expected = third_of_faces(), np.zeros(len(MESH.nodes))
    for t, nodes in enumerate(MESH.tetrahedra):
        for i, node in enumerate(nodes):
            alone = (MESH.tetrahedra == node).any(axis=1).sum() == 1
            counted = shear[t] if t != 3 or alone else 1e4  # the mean of soft and stiff
            expected[node] += counted * areas[t, i]
    np.testing.assert_allclose(withstood(shear), expected, rtol=1e-12)
