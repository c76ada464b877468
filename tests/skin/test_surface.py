"""Skin surfaces: sheets, files, areas and normals."""

import sys

import numpy as np
import pytest
from sphere_surface import sphere

from us_sim.errors import MeshError
from us_sim.geometry.triangles import compute_vertex_normals
from us_sim.skin.surface import TriangleSurface, bent_surface, plane_surface, read_surface


def ball(radius):
    return TriangleSurface(*sphere(radius))


def test_normals_of_a_sphere_point_away_from_its_centre():
    round_ = ball(0.05)
    normals = compute_vertex_normals(round_.vertices, round_.triangles)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-12)
    assert np.einsum("ij,ij->i", normals, round_.vertices / 0.05).min() > np.cos(np.radians(1.0))


def test_a_flat_sheet_lies_in_z_0_and_faces_out_of_the_body():
    sheet = plane_surface((0.2, 0.1), 0.01)
    assert sheet.vertices.shape == (21 * 11, 3)
    assert len(sheet.triangles) == 2 * 20 * 10
    # Euler: V - E + F = 1 for a disc.
    assert len(sheet.vertices) - len(sheet.edges) + len(sheet.triangles) == 1
    np.testing.assert_allclose(sheet.vertices.min(axis=0), [-0.1, -0.05, 0], atol=1e-15)
    np.testing.assert_allclose(sheet.vertices.max(axis=0), [0.1, 0.05, 0], atol=1e-15)
    np.testing.assert_array_equal(
        compute_vertex_normals(sheet.vertices, sheet.triangles), np.tile([0, 0, -1.0], (231, 1))
    )


def test_a_bent_sheet_is_flat_and_then_two_arcs_downwards():
    radius, flat = 0.04, 0.03
    sheet = bent_surface((0.03 + 0.04 * np.pi, 0.02), 0.002, flat_width=flat, radius=radius)
    x, _, z = sheet.vertices.T
    on_top = np.abs(x) < flat / 2
    assert on_top.any()
    assert not z[on_top & (z < radius / 2)].any()
    side = np.abs(x) > flat / 2 + 1e-9
    np.testing.assert_allclose(
        np.hypot(np.abs(x[side]) - flat / 2, z[side] - radius), radius, rtol=1e-12
    )
    # A quarter circle on each side ends where it points straight down.
    assert np.abs(x).max() == pytest.approx(flat / 2 + radius)
    assert z.max() == pytest.approx(radius)
    normals = compute_vertex_normals(sheet.vertices, sheet.triangles)
    outward = np.column_stack([np.sign(x) * (np.abs(x) - flat / 2), 0 * x, z - radius])[side]
    outward /= np.linalg.norm(outward, axis=1)[:, None]
    assert np.einsum("ij,ij->i", normals[side], outward).min() > np.cos(np.radians(3))


@pytest.mark.parametrize("kind", ["obj", "ply", "stl", "vtk"])
def test_a_sheet_comes_back_from_a_file(tmp_path, kind):
    meshio = pytest.importorskip("meshio")
    sheet = bent_surface((0.1, 0.04), 0.01, flat_width=0.05, radius=0.05)
    stray = np.vstack([sheet.vertices * 1000, [[7.0, 7.0, 7.0]]])
    points = sheet.vertices * 1000 if kind == "stl" else stray
    path = tmp_path / f"sheet.{kind}"
    meshio.write(path, meshio.Mesh(points, [("triangle", sheet.triangles)]))
    read = read_surface(path, metres_per_unit=1e-3)
    # STL has neither shared vertices nor double precision.
    assert read.vertices.shape == sheet.vertices.shape
    assert len(read.triangles) == len(sheet.triangles)
    assert len(read.edges) == len(sheet.edges)
    np.testing.assert_allclose(
        np.sort(read.vertex_areas), np.sort(sheet.vertex_areas), rtol=1e-4, atol=1e-9
    )


def test_a_real_organ_is_a_closed_surface(shared_data):
    organ = read_surface(shared_data / "meshes-sofa" / "liver-smooth.obj")
    assert (len(organ.vertices), len(organ.triangles)) == (2194, 4384)
    # Euler: V - E + F = 2 for a closed surface without handles.
    assert len(organ.vertices) - len(organ.edges) + len(organ.triangles) == 2
    a, b, c = organ.vertices[organ.triangles.T]
    assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() > 0


def test_a_real_head_with_texture_coordinates_is_read(shared_data):
    """It has 3969 texture coordinates for 3931 vertices, and quadrilaterals."""
    head = read_surface(shared_data / "meshes-sofa" / "head.obj")
    assert len(head.vertices) == 3931


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("broken.stl", "solid nothing\nfacet", "not a surface"),
        ("points.obj", "v 0 0 0\nv 1 0 0\n", "no triangles"),
        ("nan.obj", "v 0 0 0\nv 1 nan 0\nv 0 0 1\nf 1 2 3\n", "not finite"),
        ("flat.obj", "v 0 0\n", "line 1: 'v 0 0'"),
        ("far.obj", "v 0 0 0\nf 1 2 3\n", "line 2: 'f 1 2 3': .*vertex 2"),
        ("line.obj", "v 0 0 0\nv 1 0 0\nf 1 2\n", "three vertices"),
    ],
)
def test_files_that_cannot_be_read_are_refused(tmp_path, name, text, words):
    (tmp_path / name).write_text(text)
    with pytest.raises(MeshError, match=words) as refused:
        read_surface(tmp_path / name)
    assert str(refused.value).startswith(str(tmp_path / name))


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(MeshError, match=r"missing\.obj"):
        read_surface(tmp_path / "missing.obj")


def test_without_meshio_the_way_out_is_said(tmp_path, monkeypatch):
    (tmp_path / "fine.stl").write_text("solid fine\nendsolid fine\n")
    monkeypatch.setitem(sys.modules, "meshio", None)
    with pytest.raises(MeshError, match="pip install meshio"):
        read_surface(tmp_path / "fine.stl")


@pytest.mark.parametrize(
    ("vertices", "triangles", "words"),
    [
        (np.eye(3) * np.nan, [[0, 1, 2]], "vertex 0"),
        (np.eye(3), [[0, 1, 3]], "vertices 0 to 3"),
        (np.eye(3), np.empty((0, 3), int), "no triangles"),
    ],
)
def test_a_surface_that_cannot_be_is_refused(vertices, triangles, words):
    with pytest.raises(MeshError, match=words):
        TriangleSurface(vertices, np.array(triangles))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: plane_surface((1.0, 0.1), 1e-5), "spacing"),
        (lambda: bent_surface((0.5, 0.1), 0.01, flat_width=0.0, radius=0.05), "half a circle"),
    ],
)
def test_a_sheet_that_cannot_be_is_refused(make, words):
    with pytest.raises(MeshError, match=words):
        make()
