"""After `us-sim compile` a simulation finds every kernel that it calls."""

import json
import subprocess
import sys

from us_sim.run.compilation import parts
from us_sim.settings.registry import SLICERS, SOLVERS

COMPILED_AND_CALLED = """
import json
import sys
from pathlib import Path

from numba.core.dispatcher import Dispatcher

from us_sim.run.compilation import compile_kernels
from us_sim.run.lockstep import render_scene
from us_sim.scene.reading import load_scene


def kernels():
    modules = [module for name, module in sys.modules.items() if name.startswith("us_sim.")]
    found = {
        kernel.py_func: kernel
        for module in modules
        for kernel in vars(module).values()
        if isinstance(kernel, Dispatcher) and kernel.py_func.__module__ == module.__name__
    }
    return {
        (function.__module__, function.__name__, str(signature))
        for function, kernel in found.items()
        for signature in kernel.signatures
    }


compile_kernels()
before = kernels()
render_scene(load_scene(sys.argv[1]), None, Path(sys.argv[2]), {})
print(json.dumps([len(before), sorted(kernels() - before)]))
"""


def test_a_scene_needs_no_kernel_that_was_not_compiled(played_scene, tmp_path):
    program = [sys.executable, "-c", COMPILED_AND_CALLED, str(played_scene), str(tmp_path / "out")]
    ran = subprocess.run(program, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    count, missed = json.loads(ran.stdout.splitlines()[-1])
    assert count > 30
    assert missed == []


def test_every_method_that_can_be_chosen_is_a_part():
    names = {name for name, _ in parts()}
    assert {*SOLVERS, *SLICERS, "skin", "camera"} <= names
