"""Meshes put in disorder and mended again, and what no repair may touch."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tissue_block import block_mesh

from us_sim.errors import MeshError
from us_sim.tissue.mesh.tetrahedral_mesh import repair

CORNER = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])


def test_a_sound_mesh_is_left_as_it_is():
    mesh = block_mesh((4, 3, 3))
    mended, report = repair(mesh.nodes, mesh.tetrahedra)
    assert report == ()
    np.testing.assert_array_equal(mended.nodes, mesh.nodes)
    np.testing.assert_array_equal(mended.tetrahedra, mesh.tetrahedra)


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=15, deadline=None)
def test_any_disorder_of_these_kinds_is_mended_and_counted(seed):
    random = np.random.default_rng(seed)
    mesh = block_mesh((4, 3, 3))
    # Every tetrahedron with its own four nodes, some turned, some twice, idle nodes in between.
    nodes = mesh.nodes[mesh.tetrahedra].reshape(-1, 3)
    corners = np.arange(len(nodes)).reshape(-1, 4)
    turned = random.choice(len(corners), 7, replace=False)
    corners[turned] = corners[turned][:, [1, 0, 2, 3]]
    corners = np.vstack([corners, corners[random.choice(len(corners), 5, replace=False)]])
    idle = random.uniform(1.0, 2.0, (4, 3))
    shuffled = random.permutation(len(nodes) + 4)
    nodes = np.vstack([nodes, idle])[np.argsort(shuffled)]
    mended, report = repair(nodes, shuffled[corners])
    assert len(mended.nodes) == len(mesh.nodes)
    assert len(mended.tetrahedra) == len(mesh.tetrahedra)
    assert mended.volumes.sum() == pytest.approx(0.002)
    assert len(mended.boundary) == len(mesh.boundary)
    joined = 4 * len(mesh.tetrahedra) - len(mesh.nodes)
    assert report[0] == f"joined {joined} nodes with another in their place"
    assert report[1:3] == (
        "left out 5 tetrahedra repeated",
        "left out 4 nodes that no tetrahedron uses",
    )
    assert report[3].startswith("turned 7 ") or report[3].startswith("turned ")


def test_a_tetrahedron_whose_nodes_become_one_is_left_out():
    nodes = CORNER[[0, 1, 2, 3, 3]]
    mesh, report = repair(nodes, [[0, 1, 2, 3], [0, 1, 3, 4]])
    assert len(mesh.tetrahedra) == 1
    assert report == (
        "joined 1 node with another in its place",
        "left out 1 tetrahedron that names a node twice",
    )


def test_a_tetrahedron_pulled_inside_out_is_refused():
    mesh = block_mesh((4, 3, 3))
    nodes = mesh.nodes.copy()
    centre = np.flatnonzero(~np.isin(np.arange(len(nodes)), mesh.boundary))[0]
    nodes[centre] += [0.0, 0.0, 0.08]
    with pytest.raises(MeshError, match=r"same side of the face they share.*after repair: turned"):
        repair(nodes, mesh.tetrahedra)


@pytest.mark.parametrize(
    ("nodes", "tetrahedra", "words"),
    [
        (np.where(CORNER == 1, np.nan, CORNER), [[0, 1, 2, 3]], "not finite, such as node 1"),
        (CORNER, [[0, 1, 2, 4]], "the mesh has nodes 0 to 3"),
        (CORNER, [[0.0, 1, 2, 3]], "float64: give integer"),
        ([*CORNER[:3], [1.0, 1, 0]], [[0, 1, 2, 3]], "1 tetrahedron is flat"),
        (CORNER[[0, 0, 0, 0]], [[0, 1, 2, 3]], "M > 0"),
    ],
)
def test_what_cannot_be_mended_is_refused(nodes, tetrahedra, words):
    with pytest.raises(MeshError, match=words):
        repair(nodes, tetrahedra)
