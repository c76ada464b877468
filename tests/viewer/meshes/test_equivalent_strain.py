"""Equivalent strain against what is known of simple states."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
from us_sim.viewer.surfaces import EquivalentStrain

PLANES = uniform_planes(-0.02, 0.02, 4)
MESH = box_mesh(PLANES, PLANES, PLANES)
STRAIN = EquivalentStrain(MESH)


def test_a_turn_and_a_shift_are_no_strain():
    turned = MESH.nodes @ Rotation.from_rotvec([0.3, -0.5, 0.9]).as_matrix().T + 0.01
    assert STRAIN.of(turned) == pytest.approx(0.0, abs=1e-12)


def test_stretch_that_keeps_the_volume_is_its_elongation():
    stretch = 1.001
    across = stretch**-0.5
    strain = STRAIN.of(MESH.nodes * [across, across, stretch])
    assert strain == pytest.approx(0.001, rel=2e-3)


def test_swelling_is_none():
    assert STRAIN.of(MESH.nodes * 1.2) == pytest.approx(0.0, abs=1e-12)


def test_simple_shear_is_its_angle_over_the_root_of_three():
    sheared = MESH.nodes.copy()
    sheared[:, 0] += 1e-3 * MESH.nodes[:, 2]
    assert STRAIN.of(sheared) == pytest.approx(1e-3 / np.sqrt(3), rel=2e-3)
