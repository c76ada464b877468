"""Areas of a carried lumen against Nanson's formula."""

import hypothesis.extra.numpy as arrays
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tubes import SIDES, block, tube_volume

from us_sim.slicing.flow.carried_lumen import CarriedLumen
from us_sim.slicing.flow.lumen import lumen_of


@pytest.fixture(scope="module")
def tube():
    volume = tube_volume()
    return lumen_of(volume.labels == 1, volume.index_to_patient)


@pytest.fixture(scope="module")
def carried(tube):
    return CarriedLumen(tube, block())


@settings(deadline=None, max_examples=30)
@given(stretch=arrays.arrays(float, (3, 3), elements=st.floats(-0.3, 0.3)))
def test_a_homogeneous_deformation_changes_areas_as_nanson_says(tube, carried, stretch):
    """n' A' = det(F) F^-T n A, of which the flow sees what is along the carried tangent."""
    deformation = np.eye(3) + stretch
    now = carried.carry(block().nodes @ deformation.T)
    along = tube.tangents @ deformation.T
    lengths = np.linalg.norm(along, axis=1)
    expected = tube.areas * np.linalg.det(deformation) / lengths
    # Tangents are differences between stations, so that the bends of a voxelled line turn a little.
    assert now.areas == pytest.approx(expected, rel=0.03)
    assert now.filled == pytest.approx(0.5 * now.areas, rel=1e-6)
    assert np.einsum("sx,sx->s", now.tangents, along / lengths[:, None]).min() > 0.99


def test_at_rest_and_without_tissue_it_is_as_it_was(tube, carried):
    for each in (carried, CarriedLumen(tube, None)):
        assert each.rest.areas == pytest.approx(tube.areas)
        assert each.rest.filled == pytest.approx(0.5 * tube.areas)


def test_a_lumen_that_is_turned_inside_out_is_empty(carried):
    nodes = block().nodes * [1.0, 1.0, -1.0]
    now = carried.carry(nodes)
    assert (now.areas == 0.0).all()
    assert (now.filled == 0.0).all()


def test_what_reaches_out_of_the_tissue_stays_where_it_is(tube):
    from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh

    half = box_mesh([-0.01, 0.0, 0.01], [-0.02, -0.01, 0.0], [0.0, 0.01, SIDES[2]])
    now = CarriedLumen(tube, half).carry(half.nodes * [1.0, 1.0, 0.5])
    y = tube.centres[:, 1]
    ratio = now.areas / tube.areas
    assert ratio[y < -3e-3] == pytest.approx(0.5, rel=0.03)
    assert ratio[y > 5e-3] == pytest.approx(1.0, rel=1e-6)
