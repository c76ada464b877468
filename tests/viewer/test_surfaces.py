"""Structures move with the nodes of the tissue, wherever these go.

Fewer triangles: closed as before, about as large, and vertices of the surface itself.

Equivalent strain against what is known of simple states.

Positions as steps: no farther from the truth than half a step, which is said.

A surface that is told once, as the page reads it, and what is no surface.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from us_sim.errors import MeshError
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
from us_sim.viewer.surfaces import (
    CarriedSurfaces,
    ColouredSurface,
    EquivalentStrain,
    StreamedSurface,
    cluster_vertices,
    simplify_surface,
    weld_corners,
)

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


def vertices_of(carried, nodes):
    """As the page computes them."""
    return np.einsum("va,vax->vx", carried.weights, nodes[carried.nodes])


@settings(max_examples=20, deadline=None)
@given(
    arrays(np.float64, (3, 3), elements=st.floats(-0.5, 0.5)),
    arrays(np.float64, 3, elements=st.floats(-0.05, 0.05)),
)
def test_what_moves_the_mesh_linearly_moves_the_structures_alike(linear, shift):
    sheet = grid(0.004)
    carried = CarriedSurfaces(MESH, [sheet], triangles=60)
    matrix = np.eye(3) + linear
    at_rest = vertices_of(carried, MESH.nodes)
    moved = vertices_of(carried, MESH.nodes @ matrix.T + shift)
    np.testing.assert_allclose(moved, at_rest @ matrix.T + shift, atol=2e-8)


def test_vertices_that_are_drawn_while_moving_come_first():
    sheets = [grid(0.004), grid(0.012)]
    carried = CarriedSurfaces(MESH, sheets, triangles=120)
    assert sum(map(len, carried.coarse)) <= 120
    assert max(part.max() for part in carried.coarse) == carried.moving - 1
    assert carried.moving < len(carried.nodes)
    at_rest = vertices_of(carried, MESH.nodes)
    for sheet, fine in zip(sheets, carried.fine, strict=True):
        np.testing.assert_allclose(at_rest[fine], sheet.vertices[sheet.triangles], atol=1e-8)


def test_what_is_not_in_the_tissue_is_refused():
    with pytest.raises(MeshError, match=r"vein is 30\.0 mm outside the tissue"):
        CarriedSurfaces(MESH, [grid(0.004), grid(0.060)])


def test_triangles_are_welded_corner_by_corner():
    sheet = grid(0.004)
    vertices, triangles = weld_corners(sheet.vertices[sheet.triangles].reshape(-1, 3))
    assert len(vertices) == len(sheet.vertices)
    np.testing.assert_array_equal(vertices[triangles], sheet.vertices[sheet.triangles])


def sphere(rings: int = 24, around: int = 48) -> tuple[np.ndarray, np.ndarray]:
    """A unit sphere, closed."""
    theta = np.linspace(0, np.pi, rings + 1)[1:-1, None]
    phi = np.linspace(0, 2 * np.pi, around, endpoint=False)[None, :]
    body = np.stack(
        [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi], -1
    ).reshape(-1, 3)
    vertices = np.concatenate([body, [[0, 0, 1], [0, 0, -1]]])
    here = np.arange(around)
    there = np.roll(here, -1)
    triangles = []
    for k in range(rings - 2):
        a, b = k * around, (k + 1) * around
        triangles.append(np.column_stack([a + here, b + here, b + there]))
        triangles.append(np.column_stack([a + here, b + there, a + there]))
    last = (rings - 2) * around
    triangles.append(np.column_stack([np.full(around, len(body)), here, there]))
    triangles.append(np.column_stack([np.full(around, len(body) + 1), last + there, last + here]))
    return vertices, np.concatenate(triangles)


def open_edges(triangles: np.ndarray) -> int:
    """How many edges are not run along as often one way as the other."""
    ends = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    key = ends.min(axis=1) << 32 | ends.max(axis=1)
    _, which = np.unique(key, return_inverse=True)
    sign = np.where(ends[:, 0] < ends[:, 1], 1, -1)
    return np.count_nonzero(np.bincount(which.ravel(), sign))


def volume(vertices: np.ndarray, triangles: np.ndarray) -> float:
    a, b, c = vertices[triangles.T]
    return float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6


VERTICES, TRIANGLES = sphere()


@settings(max_examples=30, deadline=None)
@given(st.floats(0.01, 3.0))
def test_a_closed_surface_stays_closed(cell):
    fewer = cluster_vertices(VERTICES, TRIANGLES, cell)
    assert open_edges(fewer) == 0
    assert len(fewer) <= len(TRIANGLES)
    assert set(fewer.ravel()) <= set(TRIANGLES.ravel())


@settings(max_examples=10, deadline=None)
@given(st.integers(300, 2000))
def test_half_the_triangles_hold_nearly_the_same_volume(count):
    fewer = simplify_surface(VERTICES, TRIANGLES, count)
    assert 0.5 * count < len(fewer) <= count
    assert volume(VERTICES, fewer) == pytest.approx(volume(VERTICES, TRIANGLES), rel=0.12)


STRAINED_PLANES = uniform_planes(-0.02, 0.02, 4)
STRAINED = box_mesh(STRAINED_PLANES, STRAINED_PLANES, STRAINED_PLANES)
STRAIN = EquivalentStrain(STRAINED)


def test_a_turn_and_a_shift_are_no_strain():
    turned = STRAINED.nodes @ Rotation.from_rotvec([0.3, -0.5, 0.9]).as_matrix().T + 0.01
    assert STRAIN.compute_strain(turned) == pytest.approx(0.0, abs=1e-12)


def test_stretch_that_keeps_the_volume_is_its_elongation():
    stretch = 1.001
    across = stretch**-0.5
    strain = STRAIN.compute_strain(STRAINED.nodes * [across, across, stretch])
    assert strain == pytest.approx(0.001, rel=2e-3)


def test_swelling_is_none():
    assert STRAIN.compute_strain(STRAINED.nodes * 1.2) == pytest.approx(0.0, abs=1e-12)


def test_simple_shear_is_its_angle_over_the_root_of_three():
    sheared = STRAINED.nodes.copy()
    sheared[:, 0] += 1e-3 * STRAINED.nodes[:, 2]
    assert STRAIN.compute_strain(sheared) == pytest.approx(1e-3 / np.sqrt(3), rel=2e-3)


points = arrays(np.float64, (7, 3), elements=st.floats(-0.3, 0.3))


@settings(max_examples=50, deadline=None)
@given(points, points)
def test_what_the_page_has_is_half_a_step_from_the_truth(rest, positions):
    surface = StreamedSurface(rest, np.zeros((0, 3), dtype=int))
    packet = surface.make_packet(positions, kind="skin", sequence=1, stamp=0)
    steps = np.frombuffer(packet.payload, np.int16).reshape(-1, 3)
    back = surface.points + packet.header["resolution"] * steps
    assert np.abs(back - positions).max() <= 0.5 * packet.header["resolution"] + 1e-12
    farthest = np.abs(positions - surface.points).max()
    assert packet.header["resolution"] <= 1e-6 + farthest / 32767


SQUARE = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]])
RESTING = np.array([[0, 1, 2], [0, 2, 3]])


def test_a_surface_at_rest_is_read_as_the_page_does():
    edges = np.array([[0, 1], [2, 3], [0, 2]])
    packet = StreamedSurface(SQUARE, RESTING, edges).make_rest_packet("skin_mesh", 3)
    assert [packet.header[name] for name in ("points", "triangles", "edges")] == [4, 2, 3]
    floats = np.frombuffer(packet.payload, np.float32, 12)
    indices = np.frombuffer(packet.payload, np.uint32, offset=48)
    np.testing.assert_array_equal(floats.reshape(4, 3), SQUARE.astype(np.float32))
    np.testing.assert_array_equal(indices, [*RESTING.ravel(), *edges.ravel()])


def test_another_surface_has_another_number():
    one, other = StreamedSurface(SQUARE, RESTING), StreamedSurface(SQUARE, RESTING[:1])
    assert one.number != other.number
    assert one.number == StreamedSurface(SQUARE.copy(), RESTING).number
