"""The libraries that this package builds upon: it asks for what it uses, and has what it uses."""

import ast
import functools
import importlib
import inspect
import re
import runpy
import sys
import tomllib
from pathlib import Path
from xml.etree import ElementTree

import cv2
import pytest
from packaging.requirements import Requirement

import us_sim
from us_sim.errors import TrackingError
from us_sim.tracking.camera.markers import load_dictionary

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ElementTree.parse(ROOT / "package.xml")
LIBRARIES = ("cv2", "matplotlib", "numpy", "scipy", "skimage", "tqdm", "yaml")
"""Those that a distribution has in versions of its own."""
APT = {"opencv": "opencv-python-headless", "skimage": "scikit-image", "yaml": "pyyaml"}
"""Names of packages python3-… that are not those of pip."""


@functools.cache
def named(dotted):
    """The object that a dotted name stands for, or None."""
    name, *rest = dotted.split(".")
    found = importlib.import_module(name)
    for part in rest:
        name = f"{name}.{part}"
        try:
            found = getattr(found, part)
        except AttributeError:
            try:
                found = importlib.import_module(name)
            except ImportError:
                return None
    return found


def uses(tree):
    """Each dotted name of `LIBRARIES` in a file, with the keywords it is called with."""
    begins = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                whole = alias.name if alias.asname else alias.name.partition(".")[0]
                begins[alias.asname or whole] = whole
        elif isinstance(node, ast.ImportFrom) and not node.level:
            for alias in node.names:
                begins[alias.asname or alias.name] = f"{node.module}.{alias.name}"

    @functools.cache
    def dotted(node):
        if isinstance(node, ast.Attribute):
            return f"{dotted(node.value)}.{node.attr}"
        return begins.get(node.id, "") if isinstance(node, ast.Name) else ""

    for node in ast.walk(tree):
        called = isinstance(node, ast.Call)
        name = dotted(node.func if called else node)
        if name.startswith(tuple(f"{library}." for library in LIBRARIES)):
            yield name, {each.arg for each in node.keywords if each.arg} if called else set()


@functools.cache
def parameters(name):
    """The names of a function's parameters; None where it takes any or does not tell."""
    try:
        found = inspect.signature(named(name)).parameters
    except (ValueError, TypeError):
        return None
    takes_any = any(each.kind == each.VAR_KEYWORD for each in found.values())
    return None if takes_any else set(found)


@pytest.mark.slow
@pytest.mark.parametrize("folder", ["us_sim", "tests"])
def test_the_installed_versions_have_all_that_is_used(folder):
    """Also the oldest versions that `setup.py` allows, with which CI runs this."""
    missing = set()
    for file in (ROOT / folder).rglob("*.py"):
        for name, keywords in uses(ast.parse(file.read_text(encoding="utf-8"))):
            if named(name) is None:
                missing.add((file.name, name))
            elif keywords and (known := parameters(name)) is not None:
                missing |= {(file.name, name, each) for each in keywords - known}
    either = {("source.py", f"cv2.utils.logging{end}") for end in ("", ".setLogLevel")}
    assert missing - either == set()


@pytest.fixture
def set_up(monkeypatch):
    """The arguments of setup.py's `setup` when it is called with a command."""
    given = {}
    monkeypatch.setattr(pytest.importorskip("setuptools"), "setup", given.update)
    monkeypatch.chdir(ROOT)

    def called(command):
        monkeypatch.setattr(sys, "argv", ["setup.py", command])
        runpy.run_path(str(ROOT / "setup.py"))
        return given

    return called


def plain(requirement):
    """The name of pip in a requirement."""
    return re.split(r"[<>=]", requirement)[0].lower()


def test_the_launch_file_is_where_ros_has_them(set_up):
    installed = dict(set_up("install")["data_files"])
    assert installed["share/us_sim/launch"] == ["launch/us_sim.launch.py"]


def test_pip_brings_ros_where_it_can_and_none_is_sourced(set_up, monkeypatch):
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    wheel, workspace = (set_up(verb)["install_requires"] for verb in ("bdist_wheel", "install"))
    ros = {plain(each): Requirement(each).marker for each in {*wheel} - {*workspace}}
    assert ros.keys() == {"ros-jazzy-rclpy[fastrtps]", "ros-jazzy-common-interfaces"}
    for system, machine, there in [
        ("Linux", "x86_64", True),
        ("Linux", "aarch64", False),
        ("Darwin", "x86_64", False),
    ]:
        platform = {"platform_system": system, "platform_machine": machine}
        assert {marker.evaluate(platform) for marker in ros.values()} == {there}
    monkeypatch.setenv("AMENT_PREFIX_PATH", "/opt/ros/jazzy")
    (numpy,) = {*set_up("bdist_wheel")["install_requires"]} - {*workspace}
    assert numpy.startswith("numpy<2;")  # with which the messages of Ubuntu's packages work


def test_a_workspace_of_ros_has_what_it_asks_for_and_no_more(set_up):
    asked = {plain(each) for each in set_up("install")["install_requires"]}
    lines = (ROOT / ".ci" / "requirements-ubuntu.txt").read_text(encoding="utf-8").splitlines()
    pip = {plain(line) for line in lines if not line.startswith("#")}
    names = (each.text for each in PACKAGE.iter("exec_depend"))
    apt = {name.removeprefix("python3-") for name in names if name.startswith("python3-")}
    assert asked == pip | {APT.get(name, name) for name in apt}
    assert "opencv-python-headless" in pip  # apt's is too old for markers


def test_ros_knows_the_version_of_the_package():
    assert PACKAGE.findtext("version") == us_sim.__version__


def test_so_has_an_environment_of_robostack(set_up):
    asked = dict(map(split, set_up("install")["install_requires"]))
    pixi = tomllib.loads((ROOT / "pixi.toml").read_text(encoding="utf-8"))
    found = pixi["dependencies"] | pixi["pypi-dependencies"]
    found["opencv-python-headless"] = found.pop("opencv")
    found["matplotlib"] = found.pop("matplotlib-base")
    assert {name: found[name].partition(",")[0] for name in asked} == asked
    for each in PACKAGE.iter("exec_depend"):
        of_base = not each.text.startswith(("tf2_", "visualization_"))
        name = f"ros-jazzy-{each.text.replace('_', '-')}"
        assert each.text.startswith("python3-") or of_base or name in found


def split(requirement):
    """The name of pip in a requirement, and its version."""
    name = plain(requirement)
    return name, requirement[len(name) :]


def test_an_opencv_that_finds_no_markers_is_refused(monkeypatch):
    load_dictionary.cache_clear()
    monkeypatch.delattr(cv2.aruco, "ArucoDetector", raising=False)
    with pytest.raises(TrackingError, match=re.escape(cv2.__version__)):
        load_dictionary("4X4_50")
