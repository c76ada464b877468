"""Switching between solvers, compiling them in another process, and preparing them in a thread."""

import importlib
import itertools
import os
import pickle
import subprocess
import sys
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from tissue_block import block

from us_sim.errors import SolverError
from us_sim.geometry.pose import Pose
from us_sim.kernels import kernel_folder
from us_sim.settings.registry import SOLVERS
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import uniform_material
from us_sim.tissue.solvers import switching
from us_sim.tissue.solvers.fem_cg import FemCg, FemCgSettings
from us_sim.tissue.solvers.solver import SolverSettings
from us_sim.tissue.solvers.switching import (
    Failed,
    Plan,
    Preparation,
    SwitchableTissue,
    compiled_solver,
    difference,
)

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
    with pytest.raises(SolverError, match="fem_cg"):
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
        with pytest.raises(SolverError, match="0 fixed nodes"):
            tissue.use(name)
    assert tissue.name == "msds"


SLOW = '''
"""A solver with one kernel."""
import os
from numba import njit

class Slow:
    name = "slow"

    @classmethod
    def rehearse(cls, model, settings):
        if os.environ.get("ALONE", str(os.getpid())) != str(os.getpid()):
            raise OSError("no more memory")
        kernel(1)

    def __init__(self, model, settings, progress):
        kernel(float(len(model.mesh.nodes)))  # as one that only a large tissue needs

@njit(cache=True)
def kernel(count):
    return count + 1
'''

SAID = [f"compiling slow, {said}" for said in ("kernel 1", "kernel 2", "2 kernels")]

FRAMES = """
import sys
import numba
import numpy as np
from us_sim.geometry.pose import Pose
from us_sim.tissue.linear_algebra import compliance
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
from us_sim.tissue.model import TissueModel
from us_sim.tissue.solvers.solver import create_solver

def kernels():
    found = {
        f"{value.__module__}.{value.__name__}": len(value.signatures)
        for module in list(sys.modules.values())
        for value in vars(module).values()
        if isinstance(value, numba.core.dispatcher.Dispatcher)
    }
    return {name: count for name, count in found.items() if name.startswith("us_sim.")}

compliance._KEPT = compliance._DOUBLE = 0  # as a large tissue's
box = TissueModel.block(nodes=(7, 7, 5))
mesh = TetrahedralMesh(box.mesh.nodes, box.mesh.tetrahedra)
other = TissueModel(mesh, box.materials, box.fixed, box.collider, box.contact_nodes)
presses = [(0, 0, -1), (0, 0, 4), (0, 0, 8), (4, 0, 8), (4, 0, 8), (4, 0, 2), (-9, 5, 12)]
for model, method, settings in (
    (other, "fem", {}),
    (other, "fem", {"contact": "coulomb"}),
    (box, "fem_nonlinear", {}),
    (box, "fem_nonlinear", {"contact": "coulomb", "viscosity": 1.0}),
):
    solver = create_solver(method, model, **settings)
    solver.warm_up()
    ready = kernels()
    for place in presses:
        solver.deform(Pose(position=1e-3 * np.array(place, float)))
        solver.contact_stiffness()
        solver.discretisation_error()
    solver.frame_limit = 1e-4  # no time for load steps: nodes are deep in the probe at once
    solver.deform(Pose(position=[0.0, 0.0, 0.029]))
    solver.deform(None)
    print({name for name, count in kernels().items() if count != ready.get(name)})
"""


@pytest.mark.slow
def test_no_frame_meets_a_kernel_that_is_not_compiled(tmp_path, monkeypatch):
    # What is kept of a tissue is not there, so that it is made; kernels are those of all tests.
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(kernel_folder()))
    monkeypatch.setenv("US_SIM_CACHE", str(tmp_path))
    ran = subprocess.run([sys.executable, "-c", FRAMES], capture_output=True, text=True)
    assert ran.stdout.split("\n") == ["set()"] * 4 + [""], ran.stderr


@pytest.fixture
def slow(tmp_path, monkeypatch):
    """A module with a solver, of which nothing is compiled."""
    (tmp_path / "slow_solver.py").write_text(SLOW)
    monkeypatch.syspath_prepend(tmp_path)
    yield importlib.import_module("slow_solver")
    del sys.modules["slow_solver"]


def prepared(slow):
    """The states while it is compiled beside; then how often from the cache and how often not."""
    said = []
    model = block((3, 3, 3))
    compiled_solver(
        slow.Slow, model, SolverSettings(), lambda _, text: said.append(text), elsewhere=True
    )
    assert len(slow.kernel.signatures) == 2
    return said, sum(slow.kernel.stats.cache_hits.values())


@pytest.mark.slow
def test_another_process_compiles_and_this_one_loads(slow):
    assert prepared(slow) == (SAID, 2)
    assert prepared(slow) == ([], 2)  # nothing is left to do


def test_where_the_other_process_fails_this_one_compiles(slow, monkeypatch, caplog):
    monkeypatch.setenv("ALONE", str(os.getpid()))
    assert prepared(slow) == (SAID, 0)
    assert "no more memory" in caplog.text


def test_the_other_process_ends_with_the_one_that_asked():
    command = [sys.executable, "-m", switching.__name__]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL) as other:
        pickle.dump((FemCg, block((3, 3, 3)), FemCgSettings()), other.stdin)
        other.stdin.close()
        assert other.wait(60) == 1


def test_a_solver_that_no_other_process_can_import_is_compiled_here(slow):
    slow.Slow.__qualname__ = "elsewhere.Slow"
    assert prepared(slow) == (SAID, 0)


class SlowTissue:
    """Makes a plan when it is let; what is made is the plan itself."""

    def __init__(self) -> None:
        self.begun: list[str] = []
        self.has_begun = threading.Semaphore(0)
        self.may_end = threading.Semaphore(0)

    def make(self, plan: Plan, progress: object = None, *, beside: bool) -> Plan:  # noqa: ARG002
        self.begun.append(plan.solver)
        self.has_begun.release()
        assert self.may_end.acquire(timeout=20)
        if plan.solver == "impossible":
            raise SolverError("it cannot be")
        if plan.solver == "broken":
            raise ZeroDivisionError("division by zero")
        return plan


@pytest.fixture
def tissue():
    return SlowTissue()


@pytest.fixture
def preparation(tissue):
    return Preparation(tissue)


def outcome_of(preparation):
    """The outcome in the end."""
    deadline = time.monotonic() + 20
    while (outcome := preparation.take()) is None:
        assert time.monotonic() < deadline
        time.sleep(0.001)
    return outcome


def test_nothing_waits_for_what_is_made_and_it_can_be_taken_once(preparation, tissue):
    assert (preparation.state, preparation.take()) == ("", None)
    plan = Plan("fem")
    preparation.want(plan)
    assert tissue.has_begun.acquire(timeout=20)
    assert preparation.take() is None
    assert preparation.state.endswith(" for 0 s")
    tissue.may_end.release()
    assert outcome_of(preparation) is plan
    assert preparation.take() is None
    assert preparation.state == ""


def test_the_newest_plan_wins_and_those_between_are_never_made(preparation, tissue):
    preparation.want(Plan("first"))
    assert tissue.has_begun.acquire(timeout=20)
    for name in ("second", "third", "newest"):
        preparation.want(Plan(name))
    tissue.may_end.release()
    assert tissue.has_begun.acquire(timeout=20)
    assert preparation.take() is None  # the first is no longer wanted
    tissue.may_end.release()
    assert outcome_of(preparation).solver == "newest"
    assert tissue.begun == ["first", "newest"]


def test_what_was_made_and_not_taken_gives_way_to_a_newer_plan(preparation, tissue):
    preparation.want(Plan("first"))
    tissue.may_end.release()
    deadline = time.monotonic() + 20
    while preparation.state:
        assert time.monotonic() < deadline
        time.sleep(0.001)
    preparation.want(Plan("newest"))
    assert preparation.take() is None
    tissue.may_end.release()
    assert outcome_of(preparation).solver == "newest"


def test_what_is_dropped_is_never_told(preparation, tissue):
    preparation.want(Plan("first"))
    assert tissue.has_begun.acquire(timeout=20)
    preparation.drop()
    assert preparation.state == ""
    tissue.may_end.release()
    preparation.want(Plan("newest"))
    tissue.may_end.release()
    assert outcome_of(preparation).solver == "newest"


@pytest.mark.parametrize(
    ("name", "problem"),
    [("impossible", "it cannot be"), ("broken", "ZeroDivisionError: division by zero")],
)
def test_a_failure_is_told_and_the_next_plan_is_made(preparation, tissue, name, problem):
    plan = Plan(name)
    preparation.want(plan)
    tissue.may_end.release()
    assert outcome_of(preparation) == Failed(plan, problem)
    preparation.want(Plan("fem"))
    tissue.may_end.release()
    assert outcome_of(preparation).solver == "fem"


def test_a_failure_of_a_plan_that_is_no_longer_wanted_is_not_told(preparation, tissue):
    preparation.want(Plan("impossible"))
    assert tissue.has_begun.acquire(timeout=20)
    preparation.want(Plan("fem"))
    tissue.may_end.release(2)
    assert outcome_of(preparation).solver == "fem"
    assert preparation.take() is None
