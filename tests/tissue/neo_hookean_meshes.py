"""A few cells and their tetrahedra, and what forces and tangents of neo-Hookean tissue must be."""

import numpy as np
import pytest

from us_sim.tissue.elasticity.materials import TissueMaterials
from us_sim.tissue.elasticity.neo_hookean import NeoHookean
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh, box_mesh

CELLS = box_mesh([-0.02, -0.008, 0.004, 0.02], [0.0, 0.01, 0.03], [0.0, 0.005, 0.02, 0.03])
TETRAHEDRA = TetrahedralMesh(CELLS.nodes, CELLS.tetrahedra)
BOTH = pytest.mark.parametrize("mesh", [CELLS, TETRAHEDRA], ids=["cells", "tetrahedra"])


def random_field(size: float, seed: int = 1, mesh: TetrahedralMesh = CELLS) -> np.ndarray:
    """Displacements (3, N), normally distributed; ``size`` in m."""
    return np.random.default_rng(seed).normal(size=(3, len(mesh.nodes))) * size


def assert_slopes(tissue: NeoHookean, size: float) -> None:
    """The forces are the slope of the energy and the tangent is theirs, at a random field.

    The tissue is linearised there afterwards.
    """
    displacement, change = random_field(size), random_field(1.0, 2)
    step = 1e-4 * size

    def slope(function):
        return (function(displacement + step * change) - function(displacement - step * change)) / (
            2 * step
        )

    forces = tissue.compute_forces(displacement)
    assert np.vdot(forces, change) == pytest.approx(
        slope(tissue.compute_energy), abs=1e-7 * np.linalg.norm(forces) * np.linalg.norm(change)
    )
    tissue.linearise(displacement)
    product = tissue.tangent_product(change)
    error = np.linalg.norm(product - slope(tissue.compute_forces))
    assert error < 1e-6 * np.linalg.norm(product)


def assert_cells_are_tetrahedra(materials: TissueMaterials, size: float, seed: int) -> None:
    """Energy, forces and tangent of `CELLS` are those of their `TETRAHEDRA`, at a random field."""
    displacement, change = random_field(size, seed), random_field(1.0, seed + 1)
    cells, tetrahedra = (NeoHookean(mesh, materials, np.float64) for mesh in (CELLS, TETRAHEDRA))

    def near(got, expected):
        assert abs(got - expected).max() <= 1e-12 * abs(expected).max() + 1e-20

    near(cells.compute_forces(displacement), tetrahedra.compute_forces(displacement))
    assert cells.compute_energy(displacement) == pytest.approx(
        tetrahedra.compute_energy(displacement), rel=1e-11
    )
    cells.linearise(displacement)
    tetrahedra.linearise(displacement)
    near(cells.tangent_product(change), tetrahedra.tangent_product(change))
    near(cells.diagonal_blocks(), tetrahedra.diagonal_blocks())
