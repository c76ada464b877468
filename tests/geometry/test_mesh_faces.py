"""Connected parts of graphs are those that SciPy finds."""

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from us_sim.geometry.mesh_faces import connected_parts


@pytest.mark.parametrize("edges", [0, 5, 700, 1000, 3000])
@pytest.mark.parametrize("seed", range(3))
def test_parts_of_random_graphs(edges, seed):
    one, other = np.random.default_rng(seed).integers(0, 1000, (2, edges))
    graph = coo_array((np.ones(edges), (one, other)), shape=(1000, 1000))
    count, expected = connected_components(graph, directed=False)
    found = connected_parts(1000, one, other)
    assert found.max() + 1 == count
    assert len(set(zip(found.tolist(), expected.tolist(), strict=True))) == count
