"""Compiled kernels are kept, and compiled again where any source of theirs changed."""

import ast
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

import us_sim
from us_sim.kernels import find_kernel_sources

PACKAGE = Path(us_sim.__file__).parent
CALLED = "from us_sim.kernels import njit\n\n\n@njit\ndef triple(x):\n    return 3 * x\n"
KERNEL = """
from us_sim.called import triple
from us_sim.kernels import njit

@njit(cache=True)
def thrice(x):
    return triple(x)
"""
CALL = "from us_sim.caller import thrice as t; print(t(7), sum(t.stats.cache_hits.values()))"


@pytest.fixture
def package(tmp_path):
    """A copy of the package with a kernel that calls a function of another file."""
    copy = tmp_path / "copy" / "us_sim"
    copy.mkdir(parents=True)
    for name in ("__init__.py", "cache.py", "errors.py", "kernels.py"):
        shutil.copy(PACKAGE / name, copy)
    (copy / "called.py").write_text(CALLED)
    (copy / "caller.py").write_text(KERNEL)
    return copy


@pytest.fixture
def call(package, tmp_path):
    """Call the kernel in a new process; returns its output and what it says."""

    def run(cache=tmp_path / "cache"):
        unset = {"NUMBA_CACHE_DIR", "US_SIM_CACHE"}
        environment = {name: value for name, value in os.environ.items() if name not in unset}
        environment |= {"PYTHONPATH": str(package.parent), "US_SIM_CACHE": str(cache)}
        command = [sys.executable, "-c", CALL]
        ran = subprocess.run(command, capture_output=True, text=True, env=environment, check=True)
        return ran.stdout.split(), ran.stderr

    return run


def test_a_second_process_compiles_what_changed_in_a_called_function_and_nothing_else(
    call, package
):
    assert call() == (["21", "0"], "")
    assert call() == (["21", "1"], "")
    (package / "called.py").write_text(CALLED.replace("3 * x", "11 * x"))
    assert call() == (["77", "0"], "")


@pytest.mark.slow
def test_where_nothing_can_be_kept_kernels_work_all_the_same(call, tmp_path):
    (tmp_path / "file").touch()
    for _ in range(2):
        result, said = call(tmp_path / "file")
        assert result == ["21", "0"]
        assert said.count("\n") == 1
        assert "cannot be written" in said


@pytest.mark.slow
def test_folders_of_old_sources_are_removed_but_for_the_newest(call, tmp_path):
    place = tmp_path / "cache" / "kernels"
    for days in range(8):
        folder = place / f"us_sim-0-{days}"
        folder.mkdir(parents=True)
        os.utime(folder, (then := time.time() - 86400 * (days + 0.5), then))
    call()
    kept = {folder.name for folder in place.glob("us_sim-0-*")}
    assert kept == {f"us_sim-0-{days}" for days in range(4)}


def test_every_kernel_of_the_package_is_kept_so():
    for file in PACKAGE.rglob("*.py"):
        if file.name != "kernels.py":
            lines = file.read_text(encoding="utf-8").splitlines()
            assert not [line for line in lines if line.startswith("from numba import njit")], file
            assert not [line for line in lines if line.startswith("import numba")], file


@pytest.mark.slow
def test_what_a_kernel_is_made_of_stands_in_files_whose_hash_names_the_folder():
    root = PACKAGE.parent
    hashed = {file.relative_to(root) for file in find_kernel_sources()}
    for file in hashed:
        tree = ast.parse((root / file).read_text(encoding="utf-8"))
        unhashed = {
            name.asname or name.name
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom)
            and (node.module or "").startswith("us_sim")
            and Path(*node.module.split(".")).with_suffix(".py") not in hashed
            for name in node.names
        }
        for node in tree.body:  # constants made of such
            if isinstance(node, ast.Assign) and unhashed & names_in(node.value):
                unhashed |= names_in(node.targets[0])
        for node in ast.walk(tree):
            decorators = getattr(node, "decorator_list", [])
            if any("njit" in names_in(decorator) for decorator in decorators):
                assert not unhashed & names_in(node), f"{file}: {node.name}: name `kernel` there"


def names_in(tree):
    return {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
