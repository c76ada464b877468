"""Points are found where they were put; embedded surfaces follow affine maps exactly."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from old_gmsh import as_vtu
from sphere_surface import sphere
from tissue_block import block_mesh

from us_sim.errors import MeshError
from us_sim.tissue.mesh.embedding import EmbeddedSurface, locate_points
from us_sim.tissue.mesh.file import read_mesh

MESH = block_mesh((9, 6, 6))
CENTRE = np.array([0.0, 0.0, 0.05])


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_affine_maps_of_the_tissue_are_affine_maps_of_the_surface(seed):
    random = np.random.default_rng(seed)
    vertices, triangles = sphere(0.048, rings=12, centre=CENTRE)
    surface = EmbeddedSurface(MESH, vertices, triangles)
    matrix = np.eye(3) + random.uniform(-0.3, 0.3, (3, 3))
    shift = random.uniform(-0.05, 0.05, 3)
    carried, normals = surface.deform(MESH.nodes @ matrix.T + shift)
    np.testing.assert_allclose(carried, vertices @ matrix.T + shift, atol=5e-8)
    a, b, c = np.moveaxis((vertices @ matrix.T)[triangles], 1, 0)
    expected = np.zeros_like(vertices)
    for corner in triangles.T:
        np.add.at(expected, corner, np.cross(b - a, c - a))
    expected /= np.linalg.norm(expected, axis=1)[:, None]
    np.testing.assert_allclose(normals, expected, atol=2e-5)


def test_at_rest_the_surface_is_its_own_to_the_last_bit():
    vertices, triangles = sphere(0.04, centre=CENTRE)
    surface = EmbeddedSurface(MESH, vertices, triangles)
    np.testing.assert_array_equal(surface.deform_vertices(MESH.nodes), vertices.astype(np.float32))
    np.testing.assert_array_equal(surface.triangles, triangles)


def test_normals_of_a_sphere_are_its_radii():
    vertices, triangles = sphere(0.04, rings=60, centre=CENTRE)
    _, normals = EmbeddedSurface(MESH, vertices, triangles).deform(MESH.nodes)
    radii = (vertices - CENTRE) / 0.04
    angles = np.degrees(np.arccos((normals * radii).sum(axis=1).clip(-1, 1)))
    # Facets are 3 degrees wide. Only next to the poles are those around a vertex lopsided.
    assert angles.max() < 1.0
    assert np.median(angles) < 0.05
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)


def test_volume_follows_the_tissues():
    vertices, triangles = sphere(0.04, centre=CENTRE)
    surface = EmbeddedSurface(MESH, vertices, triangles)
    squeezed = MESH.nodes * [1.2, 1.2, 0.7]

    def volume(points):
        a, b, c = np.moveaxis(points[triangles].astype(float), 1, 0)
        return np.einsum("ij,ij->", a, np.cross(b, c)) / 6

    ratio = volume(surface.deform_vertices(squeezed)) / volume(surface.deform_vertices(MESH.nodes))
    assert ratio == pytest.approx(1.2 * 1.2 * 0.7, rel=1e-4)


def test_a_little_outside_is_carried_and_counted():
    # 2 mm beyond the block's sides, top and bottom
    vertices, triangles = sphere(0.052, centre=CENTRE)
    surface = EmbeddedSurface(MESH, vertices, triangles)
    beyond = (np.abs(vertices[:, 1]) > 0.05 + 1e-6) | (np.abs(vertices[:, 2] - 0.05) > 0.05 + 1e-6)
    assert surface.outside == beyond.sum() > 0
    carried = surface.deform_vertices(MESH.nodes * 1.1)
    np.testing.assert_allclose(carried, vertices * 1.1, atol=5e-8)


def test_far_outside_is_refused_or_trimmed():
    vertices, triangles = sphere(0.09, centre=CENTRE)
    with pytest.raises(MeshError, match=r"outside .*vertex \d+ by 40"):
        EmbeddedSurface(MESH, vertices, triangles)
    trimmed = EmbeddedSurface.embed_trimmed(MESH, vertices, triangles)
    assert 0 < len(trimmed.triangles) < len(triangles)
    assert np.abs(trimmed.vertices[:, 2] - 0.05).max() < 0.05 + 0.02
    whole, kept = vertices[triangles], trimmed.vertices[trimmed.triangles]
    same = (np.abs(whole[:, None, 0] - kept[None, :5, 0]) < 1e-8).all(axis=2).any(axis=0)
    assert same.all()
    with pytest.raises(MeshError, match="outside the tissue"):
        EmbeddedSurface.embed_trimmed(MESH, vertices + 1.0, triangles)


@pytest.mark.parametrize(
    ("vertices", "triangles", "words"),
    [
        (np.zeros((3, 2)), [[0, 1, 2]], r"\(3, 2\)"),
        (np.full((3, 3), np.nan), [[0, 1, 2]], "vertex 0"),
        (np.zeros((3, 3)), [[0, 1, 3]], "vertices 0 to 3"),
        (np.zeros((3, 3)), [[-1, 1, 2]], "vertices -1 to 2"),
        (np.zeros((3, 3)), np.zeros((0, 3), int), "T > 0"),
        (np.zeros((3, 3)), [[0.0, 1.0, 2.0]], "float64"),
    ],
)
def test_what_is_no_surface_is_refused(vertices, triangles, words):
    with pytest.raises(MeshError, match=words):
        EmbeddedSurface(MESH, vertices, triangles)


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_barycentric_coordinates_give_the_point_back(seed):
    random = np.random.default_rng(seed)
    mesh = block_mesh((5, 4, 3))
    points = random.uniform([-0.15, -0.1, -0.05], [0.15, 0.1, 0.15], (200, 3))
    where = locate_points(mesh, points)
    np.testing.assert_allclose(where.weights.sum(axis=1), 1.0, atol=1e-12)
    found = where.interpolate(mesh.nodes[mesh.tetrahedra])
    np.testing.assert_allclose(found, points, atol=1e-12)
    beyond = np.maximum([-0.1, -0.05, 0.0] - points, points - [0.1, 0.05, 0.1]).clip(0.0)
    np.testing.assert_allclose(where.outside, np.linalg.norm(beyond, axis=1), atol=1e-12)
    assert (where.weights[where.outside == 0.0] >= -1e-9).all()


def test_points_made_inside_real_tetrahedra_are_found_in_them(shared_data):
    mesh, _ = read_mesh(shared_data / "meshes-sofa" / "raptorTetra_8418.vtu", 0.01)
    random = np.random.default_rng(2)
    which = random.integers(0, len(mesh.tetrahedra), 4000)
    weights = random.dirichlet([2.0] * 4, len(which))
    points = np.einsum("pa,pax->px", weights, mesh.nodes[mesh.tetrahedra[which]])
    where = locate_points(mesh, points)
    assert not where.outside.any()
    # This mesh does not overlap itself, so a point strictly inside is in one tetrahedron only.
    np.testing.assert_array_equal(where.tetrahedra, which)
    np.testing.assert_allclose(where.weights, weights, atol=1e-9)


def test_outside_an_organ_it_is_the_nearest_tetrahedron(shared_data, tmp_path):
    mesh, _ = read_mesh(as_vtu(shared_data / "meshes-sofa" / "liver2.msh", tmp_path), 0.01)
    a, b, c = np.moveaxis(mesh.nodes[mesh.boundary], 1, 0)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    lifted = (a + b + c) / 3 + 1e-5 * normal
    where = locate_points(mesh, lifted)
    np.testing.assert_allclose(where.outside, 1e-5, rtol=1e-6)
    np.testing.assert_array_equal(where.tetrahedra, mesh.boundary_tetrahedra)
