"""A tissue whose method, settings and materials change while it is deformed."""

import itertools
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numba.core import config
from tissue_block import block

from us_sim.errors import SolverError
from us_sim.geometry.pose import Pose
from us_sim.settings.registry import SOLVERS
from us_sim.tissue import live_tissue
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import make_uniform_materials
from us_sim.tissue.live_tissue import LiveTissue, TissueMethod, measure_difference
from us_sim.tissue.solvers.fem_cg import FemCgSettings

PRESSED = Pose(np.array([0.004, 0.0, 0.008]))


def switch(tissue, method):
    tissue.prepare_method(method, "a test", wait=True)
    assert tissue.adopt_prepared()


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
    return {name: converged(LiveTissue(model, TissueMethod(name))) for name in SOLVERS}


def test_distances_are_those_of_the_nodes():
    apart = measure_difference(
        np.zeros((4, 3)), np.array([[0, 0, 0], [3e-3, 0, 4e-3], [0, 0, 0], [0] * 3])
    )
    assert apart.maximum == pytest.approx(5e-3)
    assert apart.rms == pytest.approx(2.5e-3)


@pytest.mark.parametrize(("first", "second"), list(itertools.permutations(SOLVERS, 2)))
def test_a_switch_jumps_by_no_more_than_the_methods_differ(model, shapes, first, second):
    tissue = LiveTissue(model, TissueMethod(first))
    before = converged(tissue)
    switch(tissue, TissueMethod(second))
    own = measure_difference(shapes[first], shapes[second]).maximum
    for _ in range(40):
        after = tissue.deform(PRESSED).nodes
        # What takes over begins to push the tissue out of the probe anew.
        assert measure_difference(after, before).maximum <= 1.05 * own + 3e-4
        before = after
    assert tissue.solver.name == second


def test_two_methods_of_the_same_equations_agree_and_others_do_not(model):
    soft = make_uniform_materials(model.mesh, Material(10e3, 0.3, 1000.0))
    tissue = LiveTissue(block((9, 5, 5), materials=soft), TissueMethod("fem_cg", "fem"))
    converged(tissue, 60)
    assert tissue.difference.maximum < 1e-5
    switch(tissue, TissueMethod("fem_cg", "msds"))
    converged(tissue, 60)
    assert tissue.difference.maximum > 2e-4
    assert tissue.difference.rms < tissue.difference.maximum
    switch(tissue, TissueMethod("msds"))  # what was beside takes the lead
    tissue.deform(PRESSED)
    assert tissue.solver.name == "msds"
    assert tissue.difference is None


def test_settings_reach_their_solver_and_may_change_while_it_runs(model):
    few, many = FemCgSettings(iterations=1), FemCgSettings(iterations=200)
    tissue = LiveTissue(model, TissueMethod("fem_cg", settings={"fem_cg": few}))
    loose = tissue.deform(PRESSED).residual
    tissue.prepare_method(TissueMethod("fem_cg", settings={"fem_cg": many}), "fem_cg", wait=True)
    assert tissue.deform(PRESSED).residual > 1e-3  # as before, until it is adopted
    assert tissue.adopt_prepared()
    assert tissue.deform(PRESSED).residual < 1e-5 < loose


def test_another_material_takes_over_where_the_tissue_is(model):
    def constants(materials):
        return make_uniform_materials(model.mesh, materials["all"])

    tissue = LiveTissue(model, TissueMethod("fem"), constants)
    before = tissue.deform(PRESSED)
    switch(tissue, TissueMethod("fem", materials={"all": Material(20e3, 0.45)}))
    after = tissue.deform(PRESSED)
    modulus = model.materials.young_modulus[0]
    np.testing.assert_allclose(after.force, 20e3 / modulus * before.force, rtol=1e-6)
    np.testing.assert_allclose(after.nodes, before.nodes, atol=1e-9)


@pytest.mark.parametrize(
    ("method", "word"),
    [
        (TissueMethod("fem_cg", "fem_cg"), "fem_cg"),
        (TissueMethod("fem_cg", "magic"), "magic"),
        (TissueMethod("magic"), "magic"),
        (TissueMethod("broken"), "division"),
    ],
)
def test_what_cannot_be_made_is_said_and_the_tissue_goes_on(model, monkeypatch, method, word):
    tissue = LiveTissue(model, TissueMethod("fem"))
    if method.solver == "broken":
        monkeypatch.setattr(live_tissue.SOLVERS, "load", lambda _: 1 / 0)
    tissue.prepare_method(method, "a test", wait=True)
    with pytest.raises(SolverError, match=word):
        tissue.adopt_prepared()
    assert tissue.solver.name == "fem"
    assert tissue.preparation_status == ""
    monkeypatch.undo()
    switch(tissue, TissueMethod("fem_cg"))


def test_tissue_that_is_not_held_is_refused_before_anything_is_compiled(model, monkeypatch):
    loose = replace(model, fixed=np.zeros_like(model.fixed))
    monkeypatch.setattr(live_tissue, "make_small_model", None)
    for name in ("fem", "fem_cg", "fem_nonlinear"):
        with pytest.raises(SolverError, match="0 fixed nodes"):
            LiveTissue(loose, TissueMethod(name))


class Slowly:
    """Makes solvers when it is let, in place of `compile_solver`."""

    def __init__(self) -> None:
        self.begun: list[str] = []
        self.has_begun = threading.Semaphore(0)
        self.may_end = threading.Semaphore(0)

    def __call__(self, solver, model, settings, progress):
        self.begun.append(solver.name)
        progress(0.25, "factors")
        self.has_begun.release()
        assert self.may_end.acquire(timeout=20)
        return solver(model, settings)


@pytest.fixture
def tissue(model):
    return LiveTissue(model, TissueMethod("fem"))


@pytest.fixture
def slowly(tissue, monkeypatch):  # noqa: ARG001 - it is made before
    slowly = Slowly()
    monkeypatch.setattr(live_tissue, "compile_solver", slowly)
    return slowly


def test_frames_go_on_while_a_method_is_prepared(tissue, slowly):
    tissue.prepare_method(TissueMethod("msds"), "msds")
    assert slowly.has_begun.acquire(timeout=20)
    assert tissue.preparation_status == "preparing msds for 0 s, 25 % of factors"
    assert not tissue.adopt_prepared()
    tissue.deform(PRESSED)
    assert tissue.solver.name == "fem"
    slowly.may_end.release()
    tissue._thread.join(20)
    assert tissue.adopt_prepared()
    assert tissue.solver.name == "msds"
    assert tissue.preparation_status == ""
    assert not tissue.adopt_prepared()


def test_the_newest_wins_and_those_between_are_never_made(tissue, slowly):
    tissue.prepare_method(TissueMethod("msds"), "msds")
    assert slowly.has_begun.acquire(timeout=20)
    first = tissue._thread
    tissue.prepare_method(TissueMethod("fem_nonlinear"), "fem_nonlinear")
    tissue.prepare_method(TissueMethod("fem_cg"), "fem_cg")
    slowly.may_end.release(2)
    first.join(20)
    tissue._thread.join(20)
    assert tissue.adopt_prepared()
    assert tissue.solver.name == "fem_cg"
    assert slowly.begun == ["msds", "fem_cg"]


def test_what_is_set_back_drops_what_is_prepared(tissue, slowly):
    tissue.prepare_method(TissueMethod("msds"), "msds")
    assert slowly.has_begun.acquire(timeout=20)
    tissue.prepare_method(TissueMethod("fem"), "")
    assert tissue.preparation_status == ""
    slowly.may_end.release()
    tissue._thread.join(20)
    assert not tissue.adopt_prepared()
    assert tissue.solver.name == "fem"


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
box = TissueModel.make_block(nodes=(7, 7, 5))
mesh = TetrahedralMesh(box.mesh.nodes, box.mesh.tetrahedra)
other = TissueModel(mesh, box.materials, box.fixed, box.collider, box.contact_nodes)
presses = [(0, 0, -1), (0, 0, 4), (0, 0, 8), (4, 0, 8), (4, 0, 8), (4, 0, 2), (-9, 5, 12)]
for model, method, settings in (
    (other, "fem", {}),
    (box, "fem_nonlinear", {}),
):
    solver = create_solver(method, model, **settings)
    solver.warm_up()
    ready = kernels()
    for place in presses:
        solver.deform(Pose(position=1e-3 * np.array(place, float)))
        solver.compute_contact_stiffness()
        solver.estimate_discretisation_error()
    solver.frame_limit = 1e-4  # no time for load steps: nodes are deep in the probe at once
    solver.deform(Pose(position=[0.0, 0.0, 0.029]))
    solver.deform(None)
    print({name for name, count in kernels().items() if count != ready.get(name)})
"""


@pytest.mark.slow
def test_no_frame_meets_a_kernel_that_is_not_compiled(tmp_path, monkeypatch):
    # What is kept of a tissue is not there, so that it is made; kernels are those of all tests.
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(Path(config.CACHE_DIR).parent))
    monkeypatch.setenv("US_SIM_CACHE", str(tmp_path))
    ran = subprocess.run([sys.executable, "-c", FRAMES], capture_output=True, text=True)
    assert ran.stdout.split("\n") == ["set()"] * 2 + [""], ran.stderr
