"""Gravity, forces at nodes and presses to a force, against beams and columns in closed form."""

from dataclasses import replace

import numpy as np
import pytest
from tissue_block import at, settle

from us_sim.errors import MeshError, SolverError
from us_sim.geometry.collider import RoundedBox
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.model import TissueModel
from us_sim.tissue.press import press_to_force, strains_along
from us_sim.tissue.solvers.solver import create_solver

PLATE = RoundedBox(0.5, 0.5, 0.1, 0.01)
HEAVY = ("fem", "fem_nonlinear")


def beam(cells, gravity=(0.0, 0.0, 0.3)):
    """A cantilever of 100 x 10 x 10 mm."""
    return TissueModel.make_block(
        (0.1, 0.01, 0.01),
        (10 * cells + 1, cells + 1, cells + 1),
        material=Material(1e6, 0.3, 1000.0),
        held=["left"],
        gravity=gravity,
    )


def sag(solver):
    """m, of the beam's end."""
    mesh = solver.model.mesh
    moved = solver.deform(None).nodes - mesh.nodes
    return moved[mesh.nodes[:, 0] > 0.0499, 2].mean()


@pytest.mark.parametrize("name", HEAVY)
def test_a_beam_that_is_too_stiff_for_its_cells_says_by_how_much(name):
    """Euler and Bernoulli's deflection under the own weight is q L^4 / (8 E I) = 0.45 mm."""
    solver = create_solver(name, beam(2))
    assert solver.is_settled
    too_stiff = 0.45e-3 / sag(solver) - 1
    assert 0.3 < too_stiff < 0.6
    assert solver.estimate_force_error() == pytest.approx(too_stiff, rel=0.35)


@pytest.mark.slow
def test_a_beam_of_finer_cells_sags_as_the_closed_form_says():
    solver = create_solver("fem", beam(6))
    assert sag(solver) == pytest.approx(0.45e-3, rel=0.08)


def test_forces_at_the_end_bend_the_beam_as_its_weight_does_by_three_eighths():
    """P L^3 / (3 E I) beside q L^4 / (8 E I)."""
    weighed = beam(2)
    end = weighed.mesh.nodes[:, 0] > 0.0499
    force = np.zeros_like(weighed.mesh.nodes)
    force[end, 2] = 0.003 / end.sum()  # N, the whole weight
    pulled = replace(weighed, gravity=np.zeros(3), forces=force)
    ratio = sag(create_solver("fem", weighed)) / sag(create_solver("fem", pulled))
    assert ratio == pytest.approx(3 / 8, rel=0.05)


@pytest.mark.parametrize("name", HEAVY)
def test_a_column_stands_as_compressed_as_its_own_weight_makes_it_and_is_pressed_from_there(name):
    """rho g H^2 / 2 E = 2.5 mm down at the top; the probe touches it there and not before."""
    model = TissueModel.make_block(
        (0.1,) * 3,
        (5, 5, 9),
        material=Material(20e3, 0.0, 1000.0),
        collider=PLATE,
        gravity=(0.0, 0.0, 10.0),
    )
    solver = create_solver(name, model)
    rest = solver.deform(None)
    top = rest.nodes[model.contact_nodes, 2]
    np.testing.assert_allclose(top, 2.5e-3, rtol=0.03)
    assert not settle(solver, at(z=2e-3)).force.any()
    assert settle(solver, at(z=3.5e-3)).force[2] == pytest.approx(-20e3 * 0.01 * 0.01, rel=0.1)
    back = settle(solver, None)
    np.testing.assert_allclose(back.nodes, rest.nodes, atol=1e-9)
    solver.reset()
    np.testing.assert_array_equal(solver.deform(None).nodes, rest.nodes)


@pytest.mark.parametrize("name", ["fem_cg", "msds"])
def test_methods_that_know_no_load_refuse_it(name):
    with pytest.raises(SolverError, match="gravity"):
        create_solver(name, beam(1))


def test_a_load_that_nothing_can_bear_is_refused():
    soft = TissueModel.make_block(material=Material(1.0), held=["top"], gravity=(0.0, 0.0, 90.0))
    with pytest.raises(SolverError, match="balance"):
        create_solver("fem_nonlinear", soft)


@pytest.mark.parametrize("given", [{"gravity": [1.0]}, {"forces": np.full((216, 3), np.nan)}])
def test_loads_that_are_no_vectors_are_refused(given):
    with pytest.raises(MeshError, match=next(iter(given))):
        replace(TissueModel.make_block(), **given)


def test_layers_give_way_one_after_the_other():
    """Springs in series: a force of 2 N on 0.01 m2, with 10 and 40 mm of 10 and 20 kPa below."""
    model = TissueModel.make_block(
        (0.1, 0.1, 0.0),
        (5, 5, 8),
        layers=[(0.01, Material(10e3, 0.0)), (0.04, Material(20e3, 0.0))],
        collider=PLATE,
    )
    curve = press_to_force(create_solver("fem", model), 2.0, step=2e-4)
    assert curve[-1].force == pytest.approx(2.0, rel=1e-3)
    assert curve[-1].depth == pytest.approx(2 / 0.01 * (0.01 / 10e3 + 0.04 / 20e3), rel=0.01)
    strains = strains_along(model.mesh, curve[-1].deformation.nodes, np.array([0.0, 0.0, 1.0]))
    soft = model.materials.young_modulus < 15e3
    np.testing.assert_allclose(strains, np.where(soft, -0.02, -0.01), rtol=0.01)
    assert [press.depth for press in curve] == sorted(press.depth for press in curve)


def test_layers_need_nodes_of_their_own():
    with pytest.raises(MeshError, match="3 nodes"):
        TissueModel.make_block(
            nodes=(4, 4, 2), layers=[(0.01, Material(1e4)), (0.02, Material(2e4))]
        )


def test_a_force_that_is_not_reached_is_said():
    with pytest.raises(SolverError, match="above it"):
        press_to_force(create_solver("fem", TissueModel.make_block()), 5.0, at(x=1.0), deepest=2e-3)
