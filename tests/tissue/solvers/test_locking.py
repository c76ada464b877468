"""Reactions of nearly incompressible tissue against elements that do not lock."""

import numpy as np
import pytest
from tissue_block import block, block_mesh

from us_sim.geometry.pose import Pose
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import uniform_material
from us_sim.tissue.solvers.solver import create_solver

YOUNG = 10e3  # Pa


def settled_reaction(name, ratio):
    """N, of the block pressed by 12 mm."""
    mesh = block_mesh((20, 10, 10))
    model = block((20, 10, 10), materials=uniform_material(mesh, Material(YOUNG, ratio)))
    solver = create_solver(name, model)
    poses = [Pose(np.array([0.0, 0.0, z])) for z in (0.0025, 0.005, 0.0075, 0.01, 0.012)]
    for pose in poses + poses[-1:] * 200:
        deformation = solver.deform(pose)
    assert deformation.residual < 2e-5
    return -deformation.force[2]


@pytest.mark.parametrize(("ratio", "reference"), [(0.45, 3.905), (0.49, 4.035), (0.499, 4.106)])
def test_nearly_incompressible_tissue_is_no_stiffer_than_27_node_hexahedra(ratio, reference):
    """References: `evaluation.tissue.kept_reference`, its sizes 10 and 6.5 mm under the sphere."""
    # So coarse a surface, flat between its nodes, makes the dent a tenth too wide.
    assert settled_reaction("fem_nonlinear", ratio) == pytest.approx(1.1 * reference, rel=0.03)


def test_only_plain_linear_tetrahedra_lock():
    def growth(name):
        return settled_reaction(name, 0.499) / settled_reaction(name, 0.45)

    assert growth("fem") < 1.05
    assert growth("fem_cg") > 1.2
