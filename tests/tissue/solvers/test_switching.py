"""Switching between solvers, and comparing two on the same poses."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from tissue_block import block

from us_sim.errors import SolverError
from us_sim.geometry.pose import Pose
from us_sim.settings.registry import SOLVERS
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import uniform_material
from us_sim.tissue.solvers import switching
from us_sim.tissue.solvers.fem_cg import FemCgSettings
from us_sim.tissue.solvers.switching import Plan, SwitchableTissue, difference

PRESSED = Pose(np.array([0.004, 0.0, 0.008]))


def converged(tissue, frames=400):
    for _ in range(frames):
        nodes = tissue.deform(PRESSED).nodes
    return nodes


@pytest.fixture(scope="module")
def model():
    return block((9, 5, 5))


@pytest.fixture(scope="module")
def shapes(model):
    """Where each solver comes to rest under the probe."""
    return {name: converged(SwitchableTissue(model, name)) for name in SOLVERS}


def test_distances_are_those_of_the_nodes():
    apart = difference(np.zeros((4, 3)), np.array([[0, 0, 0], [3e-3, 0, 4e-3], [0, 0, 0], [0] * 3]))
    assert apart.maximum == pytest.approx(5e-3)
    assert apart.rms == pytest.approx(2.5e-3)


@pytest.mark.parametrize(("first", "second"), list(itertools.permutations(SOLVERS, 2)))
def test_a_switch_jumps_by_no_more_than_the_methods_differ(model, shapes, first, second):
    tissue = SwitchableTissue(model, first)
    before = converged(tissue)
    tissue.use(second)
    own = difference(shapes[first], shapes[second]).maximum
    for _ in range(40):
        after = tissue.deform(PRESSED).nodes
        # What takes over begins to push the tissue out of the probe anew.
        assert difference(after, before).maximum <= 1.05 * own + 3e-4
        before = after
    assert tissue.name == second


def test_two_methods_of_the_same_equations_agree_and_others_do_not(model):
    soft = uniform_material(model.mesh, Material(10e3, 0.3, 1000.0))
    tissue = SwitchableTissue(block((9, 5, 5), materials=soft), "fem_cg")
    tissue.compare_with("fem")
    converged(tissue, 60)
    assert tissue.difference.maximum < 1e-5
    tissue.compare_with("msds")
    converged(tissue, 60)
    assert tissue.difference.maximum > 2e-4
    assert tissue.difference.rms < tissue.difference.maximum
    tissue.compare_with("")
    tissue.deform(PRESSED)
    assert tissue.difference is None
    assert tissue.compared == ""


def test_the_solver_beside_can_take_the_lead(model):
    tissue = SwitchableTissue(model, "fem_cg")
    tissue.compare_with("fem")
    tissue.deform(PRESSED)
    tissue.use("fem")
    assert (tissue.name, tissue.compared) == ("fem", "")


def test_settings_reach_their_solver_and_may_change_while_it_runs(model):
    few, many = FemCgSettings(iterations=1), FemCgSettings(iterations=200)
    tissue = SwitchableTissue(model, "fem_cg", {"fem_cg": few})
    loose = tissue.deform(PRESSED).residual
    prepared = tissue.make(Plan("fem_cg", settings={"fem_cg": many}))
    assert tissue.deform(PRESSED).residual > 1e-3  # as before, until it is adopted
    tissue.adopt(prepared)
    assert tissue.deform(PRESSED).residual < 1e-5 < loose


def test_another_material_takes_over_where_the_tissue_is(model):
    tissue = SwitchableTissue(model, "fem")
    before = tissue.deform(PRESSED)
    twice = replace(model, materials=uniform_material(model.mesh, Material(20e3, 0.45)))
    tissue.adopt(tissue.make(Plan("fem", model=lambda: twice)))
    after = tissue.deform(PRESSED)
    modulus = model.materials.young_modulus[0]
    np.testing.assert_allclose(after.force, 20e3 / modulus * before.force, rtol=1e-6)
    np.testing.assert_allclose(after.nodes, before.nodes, atol=1e-9)


def test_a_solver_is_not_compared_with_itself_nor_with_an_unknown_one(model):
    tissue = SwitchableTissue(model, "fem_cg")
    with pytest.raises(SolverError, match="in use already"):
        tissue.compare_with("fem_cg")
    with pytest.raises(SolverError, match="magic"):
        tissue.compare_with("magic")
    with pytest.raises(SolverError, match="magic"):
        tissue.use("magic")
    assert tissue.name == "fem_cg"


def test_tissue_that_is_not_held_is_refused_before_anything_is_compiled(model, monkeypatch):
    tissue = SwitchableTissue(replace(model, fixed=np.zeros_like(model.fixed)), "msds")
    monkeypatch.setattr(switching, "compiled_solver", None)
    for name in ("fem", "fem_cg", "fem_nonlinear"):
        with pytest.raises(SolverError, match="around node 0 has 0 fixed nodes"):
            tissue.use(name)
    assert tissue.name == "msds"
