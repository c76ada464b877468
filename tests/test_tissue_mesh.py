"""Box meshes against the paper's counts, and what a mesh refuses."""

import numpy as np
import pytest
from tissue_block import block_mesh

from us_sim.errors import MeshError
from us_sim.tissue.mesh import TetrahedralMesh, box_mesh, uniform_planes

CORNER = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
ONE = np.array([[0, 1, 2, 3]])


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


def test_planes_may_be_graded_and_cells_conform():
    mesh = box_mesh([0.0, 0.1, 0.4], [0.0, 0.5, 0.6, 1.0], [-1.0, 0.0, 2.0])
    assert mesh.volumes.sum() == pytest.approx(0.4 * 1.0 * 3.0)
    # A surface without gaps: of a closed box of 2 x 3 x 2 cells, two triangles a cell face.
    assert len(mesh.boundary) == 2 * 2 * (2 * 3 + 3 * 2 + 2 * 2)


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


def test_node_order_is_x_then_y_then_z():
    mesh = box_mesh([0.0, 1.0], [0.0, 2.0, 3.0], [0.0, 4.0])
    np.testing.assert_array_equal(mesh.nodes[(1 * 3 + 2) * 2 + 1], [1.0, 3.0, 4.0])


@pytest.mark.parametrize(
    ("nodes", "tetrahedra", "words"),
    [
        (CORNER[:, :2], ONE, r"nodes have shape \(4, 2\)"),
        (CORNER, [[0, 1, 2]], r"tetrahedra have shape \(1, 3\)"),
        (CORNER, np.empty((0, 4), int), "M > 0"),
        (CORNER, ONE.astype(float), "float64: give integer"),
        (np.where(CORNER == 1, np.nan, CORNER), ONE, "node 1 is not finite"),
        (CORNER, [[0, 1, 2, 4]], "nodes 0 to 3"),
        (CORNER, [[-1, 1, 2, 3]], "name nodes -1 to 3"),
        (np.vstack([CORNER, [5.0, 5, 5]]), ONE, "node 4 belongs to no tetrahedron"),
        (CORNER, [[0, 2, 1, 3]], "tetrahedron 0 is flat or inverted"),
        (CORNER * [1, 1, 0], ONE, "tetrahedron 0 is flat or inverted"),
    ],
)
def test_bad_meshes_are_refused(nodes, tetrahedra, words):
    with pytest.raises(MeshError, match=words):
        TetrahedralMesh(nodes, np.asarray(tetrahedra))


@pytest.mark.parametrize(
    "planes", [[0.0], [0.0, 0.0], [1.0, 0.0], [0.0, np.nan], [[0.0, 1.0]], [0.0, np.inf]]
)
def test_bad_planes_are_refused(planes):
    with pytest.raises(MeshError, match="planes along y"):
        box_mesh([0.0, 1.0], planes, [0.0, 1.0])


def test_one_plane_is_not_enough():
    with pytest.raises(MeshError, match="1 planes"):
        uniform_planes(0.0, 1.0, 1)
