"""Meshes of organs from real files of several makers, and files that are no such thing."""

import sys

import meshio
import numpy as np
import pytest
from tissue_block import block_mesh

from us_sim.errors import MeshError
from us_sim.geometry.pose import Pose
from us_sim.tissue.mesh.file import read_mesh


@pytest.fixture
def small(tmp_path):
    """A tetrahedron of 4.5 ml, in mm."""
    file = tmp_path / "small.msh"
    corners = np.array([[0, 0, 0], [30, 0, 0], [0, 30, 0], [0, 0, 30.0]])
    meshio.write(file, meshio.Mesh(corners, [("tetra", np.array([[0, 1, 2, 3]]))]), "gmsh")
    return file


# Counts as stated by the makers (SOURCE.txt); the volume by Gauss's theorem on the boundary.
@pytest.mark.parametrize(
    ("name", "nodes", "tetrahedra", "left_out"),
    [
        ("volumetricTongue.vtu", 2238, 10980, 0),
        ("Ossicles.vtu", 1733, 5058, 0),
        ("Armadillo_Tetra_4406.vtu", 1446, 4406, 0),
        ("raptorTetra_8418.vtu", 2993, 8418, 3),
    ],
)
def test_real_meshes_are_read(shared_data, name, nodes, tetrahedra, left_out):
    mesh, said = read_mesh(shared_data / "meshes-sofa" / name, metres_per_unit=0.01)
    assert (len(mesh.nodes), len(mesh.tetrahedra)) == (nodes, tetrahedra)
    assert len(said) == bool(left_out)
    assert all(f" {left_out} nodes" in each for each in said)
    a, b, c = np.moveaxis(mesh.nodes[mesh.boundary], 1, 0)
    enclosed = np.einsum("ij,ij->", a, np.cross(b, c)) / 6
    assert mesh.volumes.sum() == pytest.approx(enclosed, rel=1e-9)


@pytest.mark.parametrize(
    "name",
    ["liver.vtk", "skull.vtp", "head.obj", "liver.obj", "SOURCE.txt", "liver.msh", "nowhere.msh"],
)
def test_real_files_of_other_things_are_refused_by_name(shared_data, name):
    with pytest.raises(MeshError, match=f"{name}: "):
        read_mesh(shared_data / "meshes-sofa" / name)


def test_a_truncated_real_mesh_is_refused(shared_data, tmp_path):
    whole = (shared_data / "meshes-sofa" / "Ossicles.vtu").read_bytes()
    file = tmp_path / "Ossicles.vtu"
    file.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(MeshError, match=file.name):
        read_mesh(file)


def test_gmsh_format_1_is_refused_with_the_way_out(shared_data):
    with pytest.raises(MeshError, match="msh41"):
        read_mesh(shared_data / "meshes-sofa" / "liver2.msh")


@pytest.mark.parametrize("suffix", [".vtk", ".vtu", ".msh", ".mesh", ".inp"])
def test_units_pose_and_formats(tmp_path, suffix):
    block = block_mesh((3, 3, 3))
    file = tmp_path / f"block{suffix}"
    meshio.Mesh(block.nodes * 1000, [("tetra", block.tetrahedra)]).write(file)
    quarter = np.sqrt(0.5)
    pose = Pose(np.array([0.0, 0.0, 0.3]), np.array([quarter, 0.0, 0.0, quarter]))
    mesh, report = read_mesh(file, 0.001, pose)
    assert report == ()
    x, y, z = block.nodes.T
    np.testing.assert_allclose(mesh.nodes, np.column_stack([x, -z, y + 0.3]), atol=1e-6)


def test_quadratic_tetrahedra_lose_their_middle_nodes(tmp_path):
    ends = np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
    pairs = [(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)]
    points = np.vstack([ends, [(ends[a] + ends[b]) / 2 for a, b in pairs]])
    file = tmp_path / "curved.vtu"
    meshio.Mesh(points, [("tetra10", np.arange(10)[None])]).write(file)
    mesh, report = read_mesh(file)
    np.testing.assert_allclose(mesh.nodes, ends)
    assert "1 quadratic" in report[0]
    assert "6 nodes" in report[1]


def test_cells_that_would_leave_holes_are_refused(tmp_path):
    file = tmp_path / "brick.vtu"
    points = np.array(
        [[x, y, z] for z in (0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))], float
    )
    meshio.Mesh(points, [("hexahedron", np.arange(8)[None])]).write(file)
    with pytest.raises(MeshError, match=r"brick\.vtu: .*hexahedron"):
        read_mesh(file)


def test_a_unit_that_cannot_be_meant_is_refused(small):
    assert read_mesh(small, 0.001)[0].volumes.sum() == pytest.approx(4.5e-6)
    with pytest.raises(MeshError, match=r"30 m .*tissue\.mesh\.unit"):
        read_mesh(small)
    with pytest.raises(MeshError, match="metres_per_unit"):
        read_mesh(small, 0)


@pytest.mark.parametrize(("metres_per_unit", "length"), [(1e-4, "0.003 m"), (0.05, "1.5 m")])
def test_a_size_that_is_hardly_that_of_a_body_is_remarked_on(small, metres_per_unit, length):
    (remark,) = read_mesh(small, metres_per_unit)[1]
    assert length in remark
    assert "`tissue.mesh.unit`" in remark


@pytest.mark.parametrize("missing", ["node", "ele"])
def test_the_second_file_of_a_pair_is_named_where_it_is_missing(tmp_path, missing):
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    mesh = meshio.Mesh(0.1 * corners, [("tetra", np.array([[0, 1, 2, 3]]))])
    mesh.write(tmp_path / "organ.node")
    there = tmp_path / {"node": "organ.ele", "ele": "organ.node"}[missing]
    assert len(read_mesh(there)[0].nodes) == 4
    (tmp_path / f"organ.{missing}").unlink()
    with pytest.raises(MeshError, match=f"organ.{missing}"):
        read_mesh(there)


def test_a_surface_is_refused_before_meshio_is_asked_for(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "meshio", None)
    (tmp_path / "beam.stl").write_bytes(b"solid beam")
    with pytest.raises(MeshError, match="surface"):
        read_mesh(tmp_path / "beam.stl")


def test_a_missing_meshio_is_named_where_it_is_needed(small, monkeypatch):
    monkeypatch.setitem(sys.modules, "meshio", None)
    with pytest.raises(MeshError, match="meshio"):
        read_mesh(small)
