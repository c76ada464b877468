"""One ROS 2 is used: that of pip, or the one that is sourced, and never parts of both."""

import os
import shutil
import subprocess
import sys
import venv
from pathlib import Path

import pytest

bootstrapper = pytest.importorskip("ros_wheels_bootstrapper")

ROOT = Path(__file__).resolve().parents[1]
VERSION = f"{sys.version_info.major}.{sys.version_info.minor}"
SET_BY_WHEELS = ("_ROS_WHEELS_BOOTSTRAP_COMPLETE", "LD_LIBRARY_PATH")
PROGRAM = """
import os
from us_sim.errors import UsSimError
from us_sim.nodes import require_rclpy
try:
    require_rclpy()
except UsSimError as error:
    print(error)
else:
    import rclpy
    print(rclpy.__file__, os.environ.get("LD_LIBRARY_PATH"))
"""


def environment(folder, *, wheels=True):
    """A new virtual environment, perhaps with a rclpy of pip; its Python."""
    venv.create(folder)
    packages = folder / "lib" / f"python{VERSION}" / "site-packages"
    if wheels:
        place = Path(bootstrapper.__file__).parent
        shutil.copytree(place, packages / place.name)
        shutil.copy(place.with_suffix(".pth"), packages)
        add_rclpy(packages)
        (packages / "ros_rclpy.libs").mkdir()
    return folder / "bin" / "python"


def add_rclpy(packages):
    (packages / "rclpy").mkdir(parents=True)
    (packages / "rclpy" / "__init__.py").touch()


@pytest.fixture
def shell(monkeypatch):
    """The variables of a new shell, in which us_sim is found."""
    for name in (*SET_BY_WHEELS, "AMENT_PREFIX_PATH"):
        monkeypatch.delenv(name, raising=False)
    return os.environ | {"PYTHONPATH": str(ROOT)}


def sourced(shell, folder, version=VERSION):
    """The variables of a shell in which a ROS 2 is sourced."""
    packages = folder / "lib" / f"python{version}" / "site-packages"
    add_rclpy(packages)
    path = os.pathsep.join([str(packages), shell["PYTHONPATH"]])
    libraries = {"LD_LIBRARY_PATH": str(folder / "lib")}
    return shell | {"AMENT_PREFIX_PATH": str(folder), "PYTHONPATH": path} | libraries


def said(python, variables, *before):
    command = [*before, str(python), "-c", PROGRAM]
    ran = subprocess.run(command, env=variables, capture_output=True, text=True, check=True)
    return ran.stdout


def test_that_of_pip_is_used_alone(tmp_path, shell):
    rclpy, libraries = said(environment(tmp_path / "env"), shell).split()
    assert rclpy.startswith(str(tmp_path / "env"))
    assert libraries.count("ros_rclpy.libs") == 1


def test_the_sourced_one_is_used_alone_where_pip_brought_none(tmp_path, shell):
    python = environment(tmp_path / "env", wheels=False)
    rclpy, libraries = said(python, sourced(shell, tmp_path / "jazzy")).split()
    assert rclpy.startswith(str(tmp_path / "jazzy"))
    assert libraries == str(tmp_path / "jazzy" / "lib")


@pytest.mark.parametrize("first", ["the sourced one", "that of pip"])
def test_two_are_not_mixed(tmp_path, shell, first):
    python, variables = environment(tmp_path / "env"), sourced(shell, tmp_path / "jazzy")
    if first == "that of pip":
        variables["PYTHONPATH"] = shell["PYTHONPATH"]
    told = said(python, variables)
    assert told.startswith(f"two ROS 2 would be mixed, {tmp_path / 'jazzy'} and that of pip")
    assert "a shell in which none is sourced" in told


def test_the_sourced_one_of_another_python_is_said(tmp_path, shell):
    python = environment(tmp_path / "env", wheels=False)
    told = said(python, sourced(shell, tmp_path / "jazzy", "3.9"))
    assert f"is of Python 3.9, and this is {VERSION}" in told


def test_another_environment_is_left_before_one_is_started(tmp_path, shell):
    one, other = environment(tmp_path / "one"), environment(tmp_path / "other")
    program = f"import os; print(*map(os.environ.get, {SET_BY_WHEELS}))"
    command = [str(one), "-c", program]
    ran = subprocess.run(command, env=shell, capture_output=True, text=True, check=True)
    inherited = shell | dict(zip(SET_BY_WHEELS, ran.stdout.split(), strict=True))
    assert "start it without the variables _ROS_WHEELS" in said(other, inherited)
    leave = f'. {ROOT}/.ci/leave_environment; exec "$@"'
    rclpy, libraries = said(other, inherited, "bash", "-c", leave, "-").split()
    assert rclpy.startswith(str(tmp_path / "other"))
    assert str(tmp_path / "one") not in libraries
