"""Feet on a plane, a cylinder and a sphere, whose closest points are known."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from us_sim.errors import MeshError
from us_sim.skin.surface import bent_surface, plane_surface
from us_sim.tracking.virtual_hand.rest_surface import RestSurface

RADIUS = 0.045


def cylinder() -> RestSurface:
    """Half a cylinder about the line x = 0, z = RADIUS, along y; facets of 2 degrees."""
    size = (math.pi * RADIUS, 0.1)
    sheet = bent_surface(size, math.radians(2) * RADIUS, flat_width=0.0, radius=RADIUS)
    return RestSurface(sheet.vertices, sheet.triangles)


def sphere(steps: int = 90) -> RestSurface:
    """About the origin, by latitude and longitude."""
    polar, turn = np.linspace(0, math.pi, steps + 1), np.arange(2 * steps) * math.pi / steps
    grid = np.stack(
        [
            np.outer(np.sin(polar), np.cos(turn)),
            np.outer(np.sin(polar), np.sin(turn)),
            np.outer(np.cos(polar), np.ones_like(turn)),
        ],
        axis=-1,
    )
    index = np.arange(grid.shape[0] * grid.shape[1]).reshape(grid.shape[:2])
    a, b = index[:-1], index[1:]
    c, d = np.roll(b, -1, axis=1), np.roll(a, -1, axis=1)
    triangles = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
    return RestSurface(RADIUS * grid.reshape(-1, 3), triangles)


PLANE, CYLINDER, SPHERE = RestSurface.plane(0.1), cylinder(), sphere()
FACET = RADIUS * (1 - math.cos(math.radians(1)))  # how deep a facet of 2 degrees lies below


@settings(max_examples=40, deadline=None)
@given(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))
def test_on_a_plane_the_foot_is_straight_below(x, y, z):
    foot = PLANE.closest(np.array([x, y, z]))
    np.testing.assert_allclose(foot.point, [x, y, 0.0], atol=1e-15)
    np.testing.assert_allclose(foot.normal, [0.0, 0.0, -1.0])


@settings(max_examples=40, deadline=None)
@given(st.floats(-1.3, 1.3), st.floats(-0.045, 0.045), st.floats(-0.02, 0.05))
def test_on_a_cylinder_the_foot_is_on_the_radius(angle, y, height):
    outwards = np.array([math.sin(angle), 0.0, -math.cos(angle)])
    axis = np.array([0.0, y, RADIUS])
    foot = CYLINDER.closest(axis + (RADIUS + height) * outwards)
    np.testing.assert_allclose(foot.normal, outwards, atol=math.radians(1.05))
    # On a facet the closest point is up to the facet's slope times the height beside the radius.
    beside = math.radians(1.05) * abs(height) + FACET
    np.testing.assert_allclose(foot.point, axis + RADIUS * outwards, atol=beside)


@settings(max_examples=40, deadline=None)
@given(st.floats(0.3, 2.8), st.floats(-3, 3), st.floats(-0.02, 0.02))
def test_under_finds_the_normal_through_a_place(polar, turn, press):
    radius = np.array(
        [
            math.sin(polar) * math.cos(turn),
            math.sin(polar) * math.sin(turn),
            math.cos(polar),
        ]
    )
    foot, inwards = SPHERE.under((RADIUS - press) * radius)
    assert inwards == pytest.approx(press, abs=2 * FACET)
    np.testing.assert_allclose(foot.normal, radius, atol=0.012)  # skewed cells
    np.testing.assert_allclose(
        foot.point - inwards * foot.normal, (RADIUS - press) * radius, atol=1e-7
    )


def test_the_normal_does_not_jump_at_the_edges_of_facets():
    way = np.linspace(-1.2, 1.2, 4001)
    normals = np.array(
        [
            CYLINDER.closest(
                np.array([RADIUS * math.sin(a), 0.003, RADIUS - RADIUS * math.cos(a)])
            ).normal
            for a in way[::10]
        ]
    )
    turns = np.degrees(np.arccos(np.clip((normals[1:] * normals[:-1]).sum(axis=1), -1, 1)))
    assert turns.max() < 1.5 * np.degrees(way[10] - way[0])  # facets alone would jump by 2 degrees


@settings(max_examples=40, deadline=None)
@given(st.floats(-0.05, 0.05), st.floats(-0.04, 0.04))
def test_walking_keeps_its_length_and_bends_with_the_skin(across, along):
    start = CYLINDER.closest(np.array([0.0, 0.0, -0.01]))
    foot = CYLINDER.walk(start, np.array([across, along, 0.0]))
    angle = math.atan2(foot.point[0], RADIUS - foot.point[2])
    assert RADIUS * angle == pytest.approx(across, abs=2e-4)
    assert foot.point[1] == pytest.approx(along, abs=2e-4)


def test_at_an_edge_one_stays():
    foot = PLANE.walk(PLANE.closest(np.zeros(3)), np.array([0.0, 5.0, 0.0]))
    np.testing.assert_allclose(foot.point, [0.0, 0.1, 0.0], atol=1e-12)


def test_above_is_the_side_that_faces_the_probe():
    top = SPHERE.above(0.0, 0.02)
    np.testing.assert_allclose(top.point[:2], [0.0, 0.02], atol=1e-12)
    assert top.point[2] == pytest.approx(-math.sqrt(RADIUS**2 - 0.02**2), abs=2 * FACET)
    beside = PLANE.above(3.0, 0.0)
    np.testing.assert_allclose(beside.point, [0.1, 0.0, 0.0], atol=1e-12)


def test_the_closest_point_is_that_of_all_triangles_tried_one_by_one():
    sheet = plane_surface((0.02, 0.02), 0.002)
    generator = np.random.default_rng(4)
    vertices = sheet.vertices + generator.normal(scale=3e-4, size=sheet.vertices.shape)
    surface = RestSurface(vertices, sheet.triangles)
    weights = generator.dirichlet([1, 1, 1], size=400)
    for point in generator.uniform(-0.015, 0.015, size=(20, 3)):
        samples = np.einsum("wc,tcx->twx", weights, vertices[sheet.triangles])
        least = np.linalg.norm(samples - point, axis=2).min()
        distance = np.linalg.norm(surface.closest(point).point - point)
        assert distance <= least + 1e-12
        assert distance == pytest.approx(least, abs=3e-4)


def cube(turn: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Corners and outward triangles of a cube of 2 cm about the origin, turned about y (rad)."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.01
    hull = ConvexHull(corners)
    a, b, c = (corners[hull.simplices[:, k]] for k in range(3))
    inwards = np.einsum("tx,tx->t", np.cross(b - a, c - a), a) < 0  # about the origin
    triangles = np.where(inwards[:, None], hull.simplices[:, ::-1], hull.simplices)
    cosine, sine = math.cos(turn), math.sin(turn)
    return corners @ [[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]], triangles


def test_the_upper_side_of_a_cube_is_its_face_at_the_least_z():
    surface = RestSurface.upper_side(*cube())
    np.testing.assert_allclose(surface.lower, [-0.01, -0.01, -0.01])
    np.testing.assert_allclose(surface.upper, [0.01, 0.01, -0.01])
    foot = surface.closest(np.array([0.003, 0.004, 0.02]))  # nearer to the lower face
    np.testing.assert_allclose(foot.point, [0.003, 0.004, -0.01])
    np.testing.assert_allclose(foot.normal, [0, 0, -1])


@pytest.mark.parametrize(("degrees", "is_upper"), [(15, False), (20, True)])
def test_a_side_that_is_steeper_than_the_limit_is_not_of_the_upper_side(degrees, is_upper):
    turn = math.radians(degrees)  # the side faces up by sin(turn): 0.26, and 0.34
    surface = RestSurface.upper_side(*cube(turn))
    of_the_top = 0.01 * (math.sin(turn) - math.cos(turn))
    of_the_side = 0.01 * (math.cos(turn) - math.sin(turn))
    assert surface.upper[2] == pytest.approx(of_the_side if is_upper else of_the_top)


def test_what_faces_down_only_has_no_upper_side():
    vertices, triangles = cube()
    down = vertices[triangles][:, :, 2].min(axis=1) > 0
    with pytest.raises(MeshError, match="no triangle"):
        RestSurface.upper_side(vertices, triangles[down])


@pytest.mark.parametrize(
    ("vertices", "triangles", "said"),
    [
        (np.zeros((3, 3)), [[0, 1, 2]], "no triangle with an area"),
        (np.eye(3), [[0, 1, 3]], "vertices 0 to 3, but there are only 3"),
        (np.full((3, 3), np.nan), [[0, 1, 2]], "not finite"),
        (np.eye(3), np.empty((0, 3), dtype=int), "no triangle"),
    ],
)
def test_what_is_no_surface_is_said(vertices, triangles, said):
    with pytest.raises(MeshError, match=said):
        RestSurface(vertices, np.asarray(triangles))
