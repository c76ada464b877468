"""Faults of surfaces are found, each by its own sentence."""

import numpy as np
import pytest

from us_sim.errors import VolumeError
from us_sim.volume.surfaces.closed_surface import ClosedSurface

CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def test_a_tetrahedron_is_closed_and_turned_inside_out_it_has_its_volume_below_zero():
    whole = ClosedSurface(CORNERS + 100.0, FACES)
    assert whole.fault == ""
    assert whole.volume == pytest.approx(1 / 6)
    assert whole.area == pytest.approx(1.5 + np.sqrt(3) / 2)
    inverted = ClosedSurface(CORNERS, FACES[:, ::-1])
    assert inverted.fault == ""
    assert inverted.volume == pytest.approx(-1 / 6)


def test_a_hole_a_turned_triangle_and_a_stray_vertex_are_faults():
    assert "3 of its 6 edges" in ClosedSurface(CORNERS, FACES[1:]).fault
    turned = FACES.copy()
    turned[0] = turned[0, ::-1]
    assert "the same way" in ClosedSurface(CORNERS, turned).fault
    assert "1 vertices are in no" in ClosedSurface(np.vstack([CORNERS, [9.0, 9, 9]]), FACES).fault


def test_two_bodies_that_share_a_vertex_touch_themselves():
    other = np.array([[0.0, 0, 0], [-1, 0, 0], [0, -1, 0], [0, 0, -1]])
    corners = np.vstack([CORNERS, other[1:]])
    faces = np.vstack([FACES, np.array([0, 4, 5, 6])[FACES][:, ::-1]])
    assert "touches itself at 1 vertices" in ClosedSurface(corners, faces).fault


def test_three_tetrahedra_around_an_edge_are_refused_as_two_are():
    outer = np.array([[1, -1, 0], [1, 1, 0], [-1, 1, 0], [-1, -1, 0]]) * 1.0
    corners = np.vstack([[[0.0, 0, -1], [0, 0, 1]], outer])
    one, other = np.array([0, 1, 2, 3])[FACES], np.array([0, 1, 4, 5])[FACES]
    assert "the same way" in ClosedSurface(corners, np.vstack([one, other])).fault


@pytest.mark.parametrize(
    ("vertices", "triangles", "sentence"),
    [
        (CORNERS[:, :2], FACES, "needs vertices"),
        (CORNERS, FACES[:0], "one triangle"),
        (CORNERS * np.nan, FACES, "not finite"),
        (CORNERS, FACES + 1, "names a vertex that there is not"),
    ],
)
def test_arrays_that_are_no_surface_are_refused(vertices, triangles, sentence):
    with pytest.raises(VolumeError, match=sentence):
        ClosedSurface(vertices, triangles)
