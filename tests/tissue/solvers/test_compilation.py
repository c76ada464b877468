"""Kernels are compiled before the first frame, and in another process where one goes on."""

import importlib
import os
import subprocess
import sys

import pytest
from tissue_block import block

from us_sim.kernels import kernel_folder
from us_sim.tissue.solvers.compilation import compiled_solver
from us_sim.tissue.solvers.solver import SolverSettings

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
    (box, "fem_nonlinear", {"contact": "coulomb", "viscosity": 1.0}),
):
    solver = create_solver(method, model, **settings)
    solver.warm_up()
    ready = kernels()
    for place in presses:
        solver.deform(Pose(position=1e-3 * np.array(place, float)))
        solver.contact_stiffness()
    solver.deform(None)
    print({name for name, count in kernels().items() if count != ready.get(name)})
"""


def test_no_frame_meets_a_kernel_that_is_not_compiled(tmp_path, monkeypatch):
    # What is kept of a tissue is not there, so that it is made; kernels are those of all tests.
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(kernel_folder()))
    monkeypatch.setenv("US_SIM_CACHE", str(tmp_path))
    ran = subprocess.run([sys.executable, "-c", FRAMES], capture_output=True, text=True)
    assert ran.stdout.split("\n") == ["set()"] * 3 + [""], ran.stderr


@pytest.fixture
def slow(tmp_path, monkeypatch):
    """A module with a solver, of which nothing is compiled."""
    (tmp_path / "slow_solver.py").write_text(SLOW)
    monkeypatch.syspath_prepend(tmp_path)
    yield importlib.import_module("slow_solver")
    del sys.modules["slow_solver"]


def prepared(slow):
    """What is said while it is compiled beside; then how often from the cache and how often not."""
    said = []
    model = block((3, 3, 3))
    compiled_solver(
        slow.Slow, model, SolverSettings(), lambda _, text: said.append(text), elsewhere=True
    )
    assert len(slow.kernel.signatures) == 2
    return said, sum(slow.kernel.stats.cache_hits.values())


def test_another_process_compiles_and_this_one_loads(slow):
    assert prepared(slow) == (SAID, 2)
    assert prepared(slow) == ([], 2)  # nothing is left to do


def test_where_the_other_process_fails_this_one_compiles(slow, monkeypatch, caplog):
    monkeypatch.setenv("ALONE", str(os.getpid()))
    assert prepared(slow) == (SAID, 0)
    assert "slow is compiled in this process: OSError: no more memory" in caplog.text


def test_a_solver_that_no_other_process_can_import_is_compiled_here(slow):
    slow.Slow.__qualname__ = "elsewhere.Slow"
    assert prepared(slow) == (SAID, 0)
