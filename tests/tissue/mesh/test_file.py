"""Meshes of organs from real files of several makers, and files that are no such thing."""

import sys

import meshio
import numpy as np
import pytest
from tissue_block import block_mesh

from us_sim.errors import MeshError
from us_sim.geometry.pose import Pose
from us_sim.tissue.mesh.file import parse_gmsh, read_mesh
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh

GMSH = """$NOD
4
11 0 0 0
12 30 0 0
5 0 30 0
9 0 0 30
$ENDNOD
$ELM
2
1 2 1 1 3 11 12 5
2 4 1 1 4 11 12 5 9
$ENDELM
"""


# Counts as stated by the makers (SOURCE.txt); the volume by Gauss's theorem on the boundary.
@pytest.mark.parametrize(
    ("name", "nodes", "tetrahedra", "left_out"),
    [
        ("liver.msh", 181, 596, 0),
        ("liver2.msh", 507, 1493, 0),
        ("truthcylinder1.msh", 642, 2524, 0),
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


def test_the_cylinder_has_the_volume_of_a_cylinder(shared_data):
    mesh, _ = read_mesh(shared_data / "meshes-sofa" / "truthcylinder1.msh", metres_per_unit=1e-3)
    size = np.ptp(mesh.nodes, axis=0)
    radius, length = size.min() / 2, size.max()
    assert mesh.volumes.sum() == pytest.approx(np.pi * radius**2 * length, rel=0.05)


@pytest.mark.parametrize(
    "name", ["liver.vtk", "skull.vtp", "head.obj", "liver.obj", "SOURCE.txt", "nowhere.msh"]
)
def test_real_files_of_other_things_are_refused_by_name(shared_data, name):
    with pytest.raises(MeshError, match=f"{name}: "):
        read_mesh(shared_data / "meshes-sofa" / name)


def test_a_truncated_real_mesh_is_refused(shared_data, tmp_path):
    for name in ("liver2.msh", "Ossicles.vtu"):
        whole = (shared_data / "meshes-sofa" / name).read_bytes()
        file = tmp_path / name
        file.write_bytes(whole[: len(whole) // 2])
        with pytest.raises(MeshError, match=name):
            read_mesh(file)


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


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("$ENDNOD", ""), r"\$NOD"),
        (("$NOD\n4", "$NOD\n5"), "4 lines.* 5"),
        (("12 30 0 0", "12 30 0"), "three coordinates"),
        (("12 30 0 0", "12 30 x 0"), "a number should"),
        (("2 4 1 1 4 11 12 5 9", "2 4 1 1 4 11 12 5"), "fewer nodes"),
        (("4 11 12 5 9", "4 11 12 5 8"), "node 8"),
        (("12 30 0 0", "11 30 0 0"), "the number 11"),
        (("11 0 0 0", "99999999999999999999 0 0 0"), "a number should"),
        (("11 12 5 9", "11 12 5 99999999999999999999"), "9{20}"),
        (("2 4 1 1 4 11 12 5 9", "2 5 1 1 4 11 12 5 9"), "type 5"),
        (("2 4 1 1 4 11 12 5 9", "2 2 1 1 3 11 12 5"), "no tetrahedra"),
        (("12 30 0 0", "12 nan 0 0"), "not finite"),
        (("12 30 0 0", "12 0 30 0"), "tetrahedron names a node|M > 0"),
        (("12 30 0 0", "12 0 -40 0"), "flat"),
    ],
)
def test_what_is_wrong_in_an_old_gmsh_file_is_said(tmp_path, change, words):
    file = tmp_path / "small.msh"
    file.write_text(GMSH.replace(*change))
    with pytest.raises(MeshError, match=rf"small\.msh: .*({words})"):
        read_mesh(file, 0.001)


def test_a_unit_that_cannot_be_meant_is_refused(tmp_path):
    file = tmp_path / "small.msh"
    file.write_text(GMSH)
    assert read_mesh(file, 0.001)[0].volumes.sum() == pytest.approx(4.5e-6)
    with pytest.raises(MeshError, match=r"30 m .*tissue\.mesh\.unit"):
        read_mesh(file)
    with pytest.raises(MeshError, match="metres_per_unit"):
        read_mesh(file, 0)


@pytest.mark.parametrize(("metres_per_unit", "length"), [(1e-4, "0.003 m"), (0.05, "1.5 m")])
def test_a_size_that_is_hardly_that_of_a_body_is_remarked_on(tmp_path, metres_per_unit, length):
    file = tmp_path / "small.msh"
    file.write_text(GMSH)
    (remark,) = read_mesh(file, metres_per_unit)[1]
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


def test_a_missing_meshio_is_named_where_it_is_needed(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "meshio", None)
    old = tmp_path / "small.msh"
    old.write_text(GMSH)
    assert len(read_mesh(old, 0.001)[0].tetrahedra) == 1
    other = tmp_path / "small.vtu"
    other.write_text("<VTKFile/>")
    with pytest.raises(MeshError, match=r"\.vtu .*meshio"):
        read_mesh(other)


def _as_gmsh(file, form, binary):
    """A box by meshio, in Gmsh's format; its nodes and tetrahedra."""
    planes = np.linspace(0.0, 0.1, 3)
    box = box_mesh(planes, planes, planes)
    meshio.write(
        file, meshio.Mesh(box.nodes, [("tetra", box.tetrahedra)]), file_format=form, binary=binary
    )
    return box


@pytest.mark.parametrize("form", ["gmsh22", "gmsh"])
@pytest.mark.parametrize("binary", [False, True])
def test_gmsh_files_are_read_as_meshio_reads_them(tmp_path, form, binary):
    box = _as_gmsh(tmp_path / "box.msh", form, binary)
    points, tetrahedra, quadratic = parse_gmsh((tmp_path / "box.msh").read_bytes())
    np.testing.assert_array_equal(points, box.nodes)
    np.testing.assert_array_equal(tetrahedra, box.tetrahedra)
    assert quadratic == 0


@pytest.mark.parametrize("form", ["gmsh22", "gmsh"])
def test_a_gmsh_node_0_is_none(tmp_path, form):
    file = tmp_path / "box.msh"
    box = _as_gmsh(file, form, binary=False)
    first = " ".join(str(number + 1) for number in box.tetrahedra[0])
    text = file.read_text()
    assert text.count(f" {first}\n") == 1
    file.write_text(text.replace(f" {first}\n", f" 0 {first.split(' ', 1)[1]}\n"))
    with pytest.raises(MeshError, match="node 0"):
        read_mesh(file)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("$Nodes\n1 27 ", "$Nodes\n1 28 ", "28 nodes.* 27"),
        ("$Nodes\n1 27 ", "$Nodes\n2 27 ", "fewer numbers"),
        ("$Elements\n1 40 ", "$Elements\n1 4800000000 ", "4800000000 elements"),
        ("4.1 0 8", "4.1 0 4", "version"),
        ("$EndNodes", "$End", "no whole part"),
    ],
)
def test_gmsh_counts_that_do_not_fit_are_refused(tmp_path, old, new, words):
    file = tmp_path / "box.msh"
    _as_gmsh(file, "gmsh", binary=False)
    text = file.read_text()
    assert old in text, text[:300]
    file.write_text(text.replace(old, new))
    with pytest.raises(MeshError, match=words):
        read_mesh(file)
