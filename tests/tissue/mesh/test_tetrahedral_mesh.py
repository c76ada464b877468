"""Box meshes against the paper's counts, refused meshes, and repair of disorder."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tissue_block import block_mesh

from us_sim.errors import MeshError
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh, box_mesh, repair_mesh

CORNER = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
ONE = np.array([[0, 1, 2, 3]])
FLAT = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
TWO_ABOVE = np.vstack([CORNER, [[0.2, 0.2, 0.5]]])
THREE = np.vstack([CORNER, [[0.2, 0.2, 0.5], [0, 0, -1]]])
AT_A_FACE = [[0, 1, 2, 3], [0, 1, 2, 4], [0, 2, 1, 5]]
# A second corner beyond the tip of the first.
BOTH = np.vstack([CORNER, CORNER[3] + CORNER[1:]])


@pytest.mark.parametrize(
    ("nodes", "tetrahedra"),
    [
        ((5, 5, 5), 320),  # section IV
        ((20, 10, 10), 7_695),  # table I
        ((24, 12, 12), 13_915),
        ((28, 14, 14), 22_815),
        ((32, 16, 16), 34_875),
    ],
)
def test_as_many_tetrahedra_as_in_the_paper(nodes, tetrahedra):
    mesh = block_mesh(nodes)
    assert len(mesh.nodes) == np.prod(nodes)
    assert len(mesh.tetrahedra) == tetrahedra
    assert mesh.volumes.sum() == pytest.approx(0.002)
    assert mesh.volumes.min() > 0


def test_boundary_encloses_the_volume_with_outward_triangles():
    mesh = block_mesh((4, 3, 3))
    a, b, c = np.moveaxis(mesh.nodes[mesh.boundary], 1, 0)
    assert np.einsum("ij,ij->", a, np.cross(b, c)) / 6 == pytest.approx(0.002)
    outward = np.einsum("ij,ij->i", np.cross(b - a, c - a), (a + b + c) / 3 - [0, 0, 0.05])
    assert (outward > 0).all()


def test_edges_satisfy_eulers_formula():
    mesh = block_mesh((5, 4, 3))
    faces = (4 * len(mesh.tetrahedra) + len(mesh.boundary)) // 2
    assert len(mesh.nodes) - len(mesh.edges) + faces - len(mesh.tetrahedra) == 1
    assert (mesh.edges[:, 0] < mesh.edges[:, 1]).all()


@pytest.mark.parametrize(
    ("nodes", "tetrahedra", "words"),
    [
        (CORNER[:, :2], ONE, r"nodes .*\(4, 2\)"),
        (CORNER, np.empty((0, 4), int), "M > 0"),
        (CORNER, ONE.astype(float), "float64"),
        (np.where(CORNER == 1, np.nan, CORNER), ONE, "3 .*not finite.* node 1"),
        (CORNER, [[0, 1, 2, 4]], "nodes 0 to 3"),
        (np.vstack([CORNER, [5.0, 5, 5]]), ONE, "no tetrahedron.* node 4"),
        (CORNER, [[0, 2, 1, 3]], "inverted.* tetrahedron 0"),
        (FLAT, ONE, "flat.* tetrahedron 0"),
        (CORNER[[0, 1, 2, 3, 3]], [[0, 1, 2, 3], [0, 1, 2, 4]], "node 4 on node 3"),
        (CORNER, [[0, 1, 2, 3], [1, 2, 0, 3]], "repeated.* tetrahedron 1"),
        (TWO_ABOVE, [[0, 1, 2, 3], [0, 1, 2, 4]], "same side.* such as 0"),
        (THREE, AT_A_FACE, "more than two.* 0, 1, 2"),
        (BOTH, [[0, 1, 2, 3], [3, 4, 5, 6]], "2 parts.* node 3"),
        (BOTH[:6], [[0, 1, 2, 3], [2, 4, 5, 3]], "parts.* 2 nodes"),
        (np.zeros((2**21 + 1, 3)), ONE, "2097152"),
    ],
)
def test_bad_meshes_are_refused(nodes, tetrahedra, words):
    with pytest.raises(MeshError, match=words):
        TetrahedralMesh(nodes, np.asarray(tetrahedra))


def test_parts_are_allowed_and_told_apart():
    one = block_mesh((3, 3, 3))
    mesh = TetrahedralMesh(
        np.vstack([one.nodes, np.add(one.nodes, [1.0, 0, 0])]),
        np.vstack([one.tetrahedra, one.tetrahedra + 27]),
    )
    np.testing.assert_array_equal(mesh.parts, np.repeat([0, 1], 27))
    assert len(mesh.boundary) == 2 * len(one.boundary)


@pytest.mark.parametrize(
    "planes", [[0.0], [0.0, 0.0], [1.0, 0.0], [0.0, np.nan], [[0.0, 1.0]], [0.0, np.inf]]
)
def test_bad_planes_are_refused(planes):
    with pytest.raises(MeshError, match="planes along y"):
        box_mesh([0.0, 1.0], planes, [0.0, 1.0])


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
    mended, report = repair_mesh(nodes, shuffled[corners])
    assert len(mended.nodes) == len(mesh.nodes)
    assert len(mended.tetrahedra) == len(mesh.tetrahedra)
    assert mended.volumes.sum() == pytest.approx(0.002)
    assert len(mended.boundary) == len(mesh.boundary)
    joined = 4 * len(mesh.tetrahedra) - len(mesh.nodes)
    for said, part in zip(
        report, (f" {joined} nodes", " 5 tetrahedra", " 4 nodes", "turned "), strict=True
    ):
        assert part in said


def test_a_tetrahedron_whose_nodes_become_one_is_left_out():
    nodes = CORNER[[0, 1, 2, 3, 3]]
    mesh, report = repair_mesh(nodes, [[0, 1, 2, 3], [0, 1, 3, 4]])
    assert len(mesh.tetrahedra) == 1
    joined, left_out = report
    assert "1 node " in joined
    assert "1 tetrahedron " in left_out


def test_a_tetrahedron_pulled_inside_out_is_refused():
    mesh = block_mesh((4, 3, 3))
    nodes = mesh.nodes.copy()
    centre = np.flatnonzero(~np.isin(np.arange(len(nodes)), mesh.boundary))[0]
    nodes[centre] += [0.0, 0.0, 0.08]
    with pytest.raises(MeshError, match=r"same side.*repair: turned"):
        repair_mesh(nodes, mesh.tetrahedra)


@pytest.mark.parametrize(
    ("nodes", "tetrahedra", "words"),
    [
        (CORNER, [[0, 1, 2, 4]], "nodes 0 to 3"),
        ([*CORNER[:3], [1.0, 1, 0]], [[0, 1, 2, 3]], "flat"),
        (CORNER[[0, 0, 0, 0]], [[0, 1, 2, 3]], "M > 0"),
    ],
)
def test_what_cannot_be_mended_is_refused(nodes, tetrahedra, words):
    with pytest.raises(MeshError, match=words):
        repair_mesh(nodes, tetrahedra)
