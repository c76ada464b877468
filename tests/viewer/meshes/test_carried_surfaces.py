"""Structures move with the nodes of the tissue, wherever these go."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from us_sim.errors import MeshError
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
from us_sim.viewer.surfaces import CarriedSurfaces, ColouredSurface, welded

PLANES = uniform_planes(-0.03, 0.03, 4)
MESH = box_mesh(PLANES, PLANES, PLANES)


def grid(height: float, count: int = 12) -> ColouredSurface:
    """A square sheet of 40 mm."""
    line = np.linspace(-0.02, 0.02, count)
    x, y = np.meshgrid(line, line, indexing="ij")
    vertices = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, height)])
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    triangles = np.concatenate(
        [
            np.column_stack([corner, corner + count, corner + count + 1]),
            np.column_stack([corner, corner + count + 1, corner + 1]),
        ]
    )
    return ColouredSurface("vein", (0.2, 0.4, 0.8), vertices, triangles)


@settings(max_examples=20, deadline=None)
@given(
    arrays(np.float64, (3, 3), elements=st.floats(-0.5, 0.5)),
    arrays(np.float64, 3, elements=st.floats(-0.05, 0.05)),
)
def test_what_moves_the_mesh_linearly_moves_the_structures_alike(linear, shift):
    sheet = grid(0.004)
    carried = CarriedSurfaces(MESH, [sheet], triangles=60)
    matrix = np.eye(3) + linear
    at_rest = carried.carried(MESH.nodes)
    moved = carried.carried(MESH.nodes @ matrix.T + shift)
    np.testing.assert_allclose(moved, at_rest @ matrix.T + shift, atol=2e-8)


def test_vertices_that_are_drawn_while_moving_come_first():
    sheets = [grid(0.004), grid(0.012)]
    carried = CarriedSurfaces(MESH, sheets, triangles=120)
    assert sum(map(len, carried.coarse)) <= 120
    assert max(part.max() for part in carried.coarse) == carried.moving - 1
    assert carried.moving < len(carried.nodes)
    at_rest = carried.carried(MESH.nodes)
    for sheet, fine in zip(sheets, carried.fine, strict=True):
        np.testing.assert_allclose(at_rest[fine], sheet.vertices[sheet.triangles], atol=1e-8)


def test_what_is_told_is_read_as_the_page_does():
    carried = CarriedSurfaces(MESH, [grid(0.004)], triangles=60)
    packet = carried.told("structures", 1, mesh=77)
    count = packet.header["vertices"]
    (part,) = packet.header["parts"]
    nodes = np.frombuffer(packet.payload, np.uint32, 4 * count).reshape(-1, 4)
    weights = np.frombuffer(packet.payload, np.float32, 4 * count, 16 * count).reshape(-1, 4)
    indices = np.frombuffer(packet.payload, np.uint32, offset=32 * count)
    assert len(indices) == 3 * (part["fine"] + part["coarse"])
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-6)
    vertices = np.einsum("va,vax->vx", weights, MESH.nodes[nodes])
    np.testing.assert_allclose(vertices[:, 2], 0.004, atol=1e-8)
    assert (part["name"], packet.header["mesh"]) == ("vein", 77)


def test_what_is_not_in_the_tissue_is_refused():
    with pytest.raises(MeshError, match=r"vein is 30\.0 mm outside the tissue"):
        CarriedSurfaces(MESH, [grid(0.004), grid(0.060)])


def test_triangles_are_welded_corner_by_corner():
    sheet = grid(0.004)
    vertices, triangles = welded(sheet.vertices[sheet.triangles].reshape(-1, 3))
    assert len(vertices) == len(sheet.vertices)
    np.testing.assert_array_equal(vertices[triangles], sheet.vertices[sheet.triangles])


@pytest.mark.parametrize("corners", [np.zeros((4, 3)), np.full((3, 3), np.inf), np.zeros((3, 2))])
def test_what_is_no_triangle_is_refused(corners):
    with pytest.raises(MeshError):
        welded(corners)
