"""Surfaces of known shapes, and their files elsewhere."""

import meshio
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from us_sim.errors import VolumeError
from us_sim.skin.surface import read_surface
from us_sim.volume.surfaces.closed_surface import ClosedSurface, write_stl
from us_sim.volume.surfaces.structure_surface import structure_surface
from us_sim.volume.volume import Volume

GRID = 0.5e-3 * (np.indices((70, 70, 70)) - np.reshape((35.1, 34.7, 35.3), (3, 1, 1, 1)))


def ball(x, y, z):
    return x**2 + y**2 + z**2 < 0.015**2


def ring(x, y, z):
    return (np.hypot(x, y) - 0.010) ** 2 + z**2 < 0.0045**2


def labelled(mask, affine=None):
    placed = np.diag([0.5e-3, 0.5e-3, 0.5e-3, 1.0]) if affine is None else affine
    return Volume(np.zeros(mask.shape, np.uint8), placed, mask.astype(np.uint8), {1: "vein"})


@pytest.mark.parametrize(
    ("shape", "volume", "area", "area_error"),
    [
        (ball, 4 / 3 * np.pi * 0.015**3, 4 * np.pi * 0.015**2, 0.02),
        (ring, 2 * np.pi**2 * 0.010 * 0.0045**2, 4 * np.pi**2 * 0.010 * 0.0045, 0.02),
    ],
)
def test_known_shapes_have_their_volume_and_area(shape, volume, area, area_error):
    made = structure_surface(labelled(shape(*GRID)), 1)
    assert made.surface.volume == pytest.approx(volume, rel=0.006)
    assert made.volume_kept == pytest.approx(1.0, abs=1e-6)
    assert made.surface.area == pytest.approx(area, rel=area_error)
    assert made.surface.parts == 1


def test_parts_are_counted_and_a_smoothed_ball_is_round():
    mask = np.zeros((30, 12, 12), bool)
    mask[2:8, 2:10, 2:10] = mask[12:28, 2:10, 2:10] = True
    assert structure_surface(labelled(mask), 1).surface.parts == 2
    surface = structure_surface(labelled(ball(*GRID)), 1).surface
    radii = np.linalg.norm(surface.vertices - 0.5e-3 * np.array([35.1, 34.7, 35.3]), axis=1)
    assert np.abs(radii - 0.015).max() < 0.25e-3  # half a voxel's half


def test_without_labels_one_sentence_says_so():
    volume = labelled(ball(*GRID))
    with pytest.raises(VolumeError, match="label 7"):
        structure_surface(volume, 7)
    with pytest.raises(VolumeError, match="no labels"):
        structure_surface(Volume(volume.intensities, np.eye(4)), 1)


@given(
    mask=arrays(bool, st.tuples(*[st.integers(2, 7)] * 3)),
    steps=st.tuples(*[st.floats(0.2e-3, 2e-3)] * 3),
    mirrored=st.booleans(),
    turn=st.integers(0, 2**16),
)
@settings(max_examples=40, deadline=None)
def test_any_labels_have_a_closed_surface_that_faces_outwards(mask, steps, mirrored, turn):
    mask.flat[0] = True
    axes, _ = np.linalg.qr(np.random.default_rng(turn).normal(size=(3, 3)))
    axes *= np.sign(np.linalg.det(axes)) * (-1 if mirrored else 1)
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = axes * steps, (0.1, -0.2, 0.05)
    made = structure_surface(labelled(mask, affine), 1)
    triangles = made.surface.triangles
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    there = {tuple(edge) for edge in edges.tolist()}
    assert len(there) == len(edges)
    assert all((b, a) in there for a, b in there)
    assert made.voxels_volume == pytest.approx(mask.sum() * np.prod(steps))
    assert 0.0 < made.surface.volume < 1.1 * made.voxels_volume


CORNERS = np.array([[0.01, 0.02, 0.03], [0.05, 0, 0], [0, 0.061, 0], [0, 0, 0.0723]])
SURFACE = ClosedSurface(CORNERS, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))


def test_meshio_and_the_scenes_reader_find_the_same_surface_in_millimetres(tmp_path):
    path = tmp_path / "vein.stl"
    write_stl(path, SURFACE)
    for vertices in (meshio.read(path).points * 1e-3, read_surface(path, 1e-3).vertices):
        np.testing.assert_allclose(
            np.sort(vertices, axis=0), np.sort(SURFACE.vertices, axis=0), atol=1e-8
        )
    there = meshio.read(path)
    turned = ClosedSurface(there.points * 1e-3, there.cells_dict["triangle"])
    assert turned.volume == pytest.approx(SURFACE.volume, rel=1e-5)
    assert b"SPACE=LPS" in path.read_bytes()[:80]
