"""Volume averages against analytic fractions, and what materials are refused."""

import numpy as np
import pytest
from tissue_block import block_mesh

from us_sim.errors import MeshError
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import (
    TissueMaterials,
    average_over_labels,
    label_fractions,
)
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh, box_mesh

FAT = Material(young_modulus=3e3, poisson_ratio=0.49, density=950.0)
MUSCLE = Material(young_modulus=12e3, poisson_ratio=0.45, density=1060.0)

# Voxels of 1 mm whose indices start at the corner of the block.
INDEX = np.diag([1000.0, 1000.0, 1000.0, 1.0])
INDEX[:3, 3] = [99.5, 49.5, -0.5]


def voxels() -> np.ndarray:
    return np.ones((200, 100, 100), dtype=np.uint8)


def test_plane_through_a_tetrahedron_cuts_off_the_analytic_fraction():
    unit = TetrahedralMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2, 3]])
    index = np.diag([100.0, 100.0, 100.0, 1.0])
    index[:3, 3] = -0.5
    for height in (0.1, 0.3, 0.5, 0.7):
        labels = np.ones((100, 100, 100), dtype=np.uint8)
        labels[:, :, round(100 * height) :] = 2
        present, fractions = label_fractions(unit, labels, index)
        np.testing.assert_array_equal(present, [1, 2])
        assert fractions[0, 1] == pytest.approx((1 - height) ** 3, abs=0.01)
        assert fractions.sum() == pytest.approx(1.0)


def test_a_cylinder_keeps_its_volume():
    x, _, z = np.indices((200, 100, 100))
    labels = voxels()
    labels[np.hypot(x - 99.5, z - 29.5) < 12] = 7
    mesh = block_mesh((20, 10, 10))
    present, fractions = label_fractions(mesh, labels, INDEX)
    volume = fractions[:, present == 7].sum(axis=1) @ mesh.volumes
    assert volume == pytest.approx(np.pi * 0.012**2 * 0.1, rel=0.01)


def test_tetrahedra_smaller_than_a_voxel_take_its_label():
    labels = np.array([[[4]], [[5]]], dtype=np.uint8)
    mesh = box_mesh([0.3, 0.4], [0.3, 0.4], [0.3, 0.4])
    present, fractions = label_fractions(mesh, labels, np.eye(4))
    np.testing.assert_array_equal(present, [4])
    np.testing.assert_array_equal(fractions, np.ones((5, 1)))


def test_beyond_the_volume_its_nearest_voxel_counts():
    labels = voxels()
    labels[:, :, 99] = 3
    mesh = box_mesh([0.0, 0.01], [0.0, 0.01], [0.099, 0.2])
    present, _ = label_fractions(mesh, labels, INDEX)
    np.testing.assert_array_equal(present, [3])


def test_constants_are_averaged_by_volume():
    labels = voxels()
    labels[:100] = 2  # x < 0
    mesh = box_mesh([-0.01, 0.01, 0.03], [0.0, 0.01], [0.0, 0.01])
    averaged = average_over_labels(
        label_fractions(mesh, labels, INDEX), {1: FAT, 2: MUSCLE, 9: FAT}
    )
    assert averaged.young_modulus[5:] == pytest.approx(np.full(5, 3e3))
    # The cell astride x = 0 is half of each, its tetrahedra more or less.
    fraction = mesh.volumes[:5] / mesh.volumes[:5].sum()
    assert averaged.young_modulus[:5] @ fraction == pytest.approx(7.5e3, rel=0.01)
    assert averaged.poisson_ratio[:5] @ fraction == pytest.approx(0.47, rel=0.01)
    assert averaged.density[:5] @ fraction == pytest.approx(1005.0, rel=0.01)


def test_a_label_without_material_is_named():
    labels = voxels()
    labels[:50] = 8
    fractions = label_fractions(block_mesh((5, 3, 3)), labels, INDEX)
    with pytest.raises(MeshError, match="label 8"):
        average_over_labels(fractions, {1: FAT})


def test_a_mesh_outside_the_volume_is_refused():
    mesh = box_mesh([1.0, 1.1], [0.0, 0.1], [0.0, 0.1])
    with pytest.raises(MeshError, match="outside"):
        label_fractions(mesh, voxels(), INDEX)


@pytest.mark.parametrize(
    ("labels", "index"),
    [
        (np.ones((3, 3), np.uint8), np.eye(4)),
        (np.ones((3, 3, 3), np.int16), np.eye(4)),
        (np.ones((3, 3, 3), np.uint8), np.full((4, 4), np.nan)),
    ],
)
def test_labels_and_map_must_be_what_they_say(labels, index):
    with pytest.raises(MeshError):
        label_fractions(block_mesh((2, 2, 2)), labels, index)


@pytest.mark.parametrize(
    ("modulus", "ratio", "density", "key"),
    [
        (0.0, 0.4, 1000.0, "young_modulus"),
        (1e4, 0.5, 1000.0, "poisson_ratio"),
        (1e4, np.nan, 1000.0, "poisson_ratio"),
        (1e4, 0.4, -1.0, "density"),
    ],
)
def test_unphysical_constants_are_refused(modulus, ratio, density, key):
    with pytest.raises(MeshError, match=rf"material\.{key}: "):
        Material(modulus, ratio, density)
    with pytest.raises(MeshError, match="tetrahedron 1"):
        TissueMaterials(
            np.array([1e4, modulus]), np.array([0.4, ratio]), np.array([1000.0, density])
        )
