"""Fewer triangles: closed as before, about as large, and vertices of the surface itself."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.viewer.surfaces import at_most, clustered


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


def test_the_sphere_is_closed_before():
    assert open_edges(TRIANGLES) == 0
    assert volume(VERTICES, TRIANGLES) == pytest.approx(4 / 3 * np.pi, rel=0.01)


@settings(max_examples=30, deadline=None)
@given(st.floats(0.01, 3.0))
def test_a_closed_surface_stays_closed(cell):
    fewer = clustered(VERTICES, TRIANGLES, cell)
    assert open_edges(fewer) == 0
    assert len(fewer) <= len(TRIANGLES)
    assert set(fewer.ravel()) <= set(TRIANGLES.ravel())


@settings(max_examples=10, deadline=None)
@given(st.integers(300, 2000))
def test_half_the_triangles_hold_nearly_the_same_volume(count):
    fewer = at_most(VERTICES, TRIANGLES, count)
    assert 0.5 * count < len(fewer) <= count
    assert volume(VERTICES, fewer) == pytest.approx(volume(VERTICES, TRIANGLES), rel=0.12)


def test_what_has_few_enough_stays_as_it_is():
    assert at_most(VERTICES, TRIANGLES, len(TRIANGLES)) is TRIANGLES
