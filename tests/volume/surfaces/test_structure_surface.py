"""Surfaces of shapes whose area, volume and genus are known, and of anything at all."""

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from us_sim.errors import VolumeError
from us_sim.volume.phantom.phantom import cached_phantom
from us_sim.volume.surfaces.label_surface import voxel_surface
from us_sim.volume.surfaces.settings import SurfaceSettings
from us_sim.volume.surfaces.structure_surface import structure_surface
from us_sim.volume.volume import Volume

GRID = 0.5e-3 * (np.indices((70, 70, 70)).transpose(1, 2, 3, 0) - (35.1, 34.7, 35.3))
MATERIAL_TISSUES = ("muscle", "bone", "artery", "vein", "nerve")


def ball(x, y, z):
    return x**2 + y**2 + z**2 < 0.015**2


def ring(x, y, z):
    return (np.hypot(x, y) - 0.010) ** 2 + z**2 < 0.0045**2


def two_rings(x, y, z):
    return ring(1.9 * x - 0.011, 1.9 * y, 1.9 * z) | ring(1.9 * x + 0.011, 1.9 * y, 1.9 * z)


def block(x, y, z):
    return (abs(x) < 0.015) & (abs(y) < 0.012) & (abs(z) < 0.009)


def labelled(mask, affine=None):
    placed = np.diag([0.5e-3, 0.5e-3, 0.5e-3, 1.0]) if affine is None else affine
    return Volume(np.zeros(mask.shape, np.uint8), placed, mask.astype(np.uint8), {1: "vein"})


@pytest.mark.parametrize(
    ("shape", "volume", "area", "area_error", "genus"),
    [
        (ball, 4 / 3 * np.pi * 0.015**3, 4 * np.pi * 0.015**2, 0.005, 0),
        (ring, 2 * np.pi**2 * 0.010 * 0.0045**2, 4 * np.pi**2 * 0.010 * 0.0045, 0.01, 1),
        # Edges are rounded, which takes 2 - π/2 of the radius, here a voxel or two, along each.
        (block, 0.030 * 0.024 * 0.018, 2 * (0.030 * 0.042 + 0.024 * 0.018), 0.06, 0),
    ],
)
def test_known_shapes_have_their_volume_area_and_genus(shape, volume, area, area_error, genus):
    made = structure_surface(labelled(shape(*np.moveaxis(GRID, -1, 0))), 1)
    assert made.surface.volume == pytest.approx(volume, rel=0.006)
    assert made.volume_kept == pytest.approx(1.0, abs=1e-6)
    assert made.surface.area == pytest.approx(area, rel=area_error)
    assert (made.surface.parts, made.surface.genus, made.surface.fault) == (1, genus, "")


def test_handles_and_parts_are_counted():
    eight = voxel_surface(labelled(two_rings(*np.moveaxis(GRID, -1, 0))), 1)[0]
    assert (eight.parts, eight.genus) == (1, 2)
    mask = np.zeros((30, 12, 12), bool)
    mask[2:8, 2:10, 2:10] = mask[12:28, 2:10, 2:10] = True
    mask[15:25, 5:7, :] = False  # a slot right through
    pair = voxel_surface(labelled(mask), 1)[0]
    assert (pair.parts, pair.genus, pair.fault) == (2, 1, "")


def test_a_smoothed_ball_is_round():
    surface = structure_surface(labelled(ball(*np.moveaxis(GRID, -1, 0))), 1).surface
    centre = 0.5e-3 * np.array([35.1, 34.7, 35.3])
    radii = np.linalg.norm(surface.vertices - centre, axis=1)
    assert np.abs(radii - 0.015).max() < 0.25e-3  # half a voxel's half


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
    surface, voxels = voxel_surface(labelled(mask, affine), 1)
    assert surface.fault == ""
    assert voxels == pytest.approx(mask.sum() * np.prod(steps))
    assert 0.0 < surface.volume < 1.1 * voxels  # corners of voxels are cut
    assert surface.genus >= 0


def test_five_structures_of_an_arm_keep_their_volume():
    arm = cached_phantom("upper_arm", seed=1, voxel_size=1e-3)
    numbers = {name: label for label, name in arm.label_names.items()}
    begun = time.process_time()
    made = [structure_surface(arm, numbers[name]) for name in MATERIAL_TISSUES]
    assert time.process_time() - begun < 10.0  # 0.1 s where nothing else runs
    for each in made:
        assert each.volume_kept == pytest.approx(1.0, abs=0.01), each.name
        assert each.surface.fault == ""
    assert [each.name for each in made] == list(MATERIAL_TISSUES)


def test_what_has_no_surface_is_said():
    volume = labelled(np.ones((3, 3, 3), bool))
    with pytest.raises(VolumeError, match="label 7 occurs nowhere"):
        structure_surface(volume, 7)
    with pytest.raises(VolumeError, match="no labels"):
        structure_surface(Volume(volume.intensities, np.eye(4)), 1)
    with pytest.raises(VolumeError, match=r"outside 0 to 0\.1 m"):
        SurfaceSettings(smoothing=3)
