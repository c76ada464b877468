"""What needs no rclpy works where there is none; what needs one says so in a sentence."""

import json
import os
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from session_files import press, write
from sweep_file import write_sweep

from us_sim.volume.files.writing import write_volume
from us_sim.volume.volume import Volume

ROOT = Path(__file__).resolve().parents[1]
NAMES = [each.text for each in ElementTree.parse(ROOT / "package.xml").iter("exec_depend")]
ROS = sorted(name for name in NAMES if not name.startswith("python3-"))
BLOCK = f"import sys\nsys.modules.update(dict.fromkeys({ROS}))\n"  # None: an import fails

IMPORTS = """
import importlib, json, pkgutil, sys
import us_sim

needs = []
for info in pkgutil.walk_packages(us_sim.__path__, "us_sim."):
    try:
        importlib.import_module(info.name)
    except ModuleNotFoundError as error:
        if error.name.partition(".")[0] in json.loads(sys.argv[1]):
            needs.append(info.name)
print(json.dumps(needs))
"""

SCAN = """
import sys
import gymnasium
import us_sim.environment

scan = gymnasium.make("us_sim/HoldContact-v0", scene=sys.argv[1])
scan.reset(seed=1)
for _ in range(20):
    observation, *_, info = scan.step([0, 0, 1, 0, 0, 0])  # into the tissue
print(observation["image"].std(), info["force"])
"""

COMMANDS = """
import json, sys
from us_sim.command.main import main

print(json.dumps([main(words) for words in json.loads(sys.argv[1])]))
"""

SEEDS = """structures:
  vein: {upper: 40, seeds_mm: [[0, 0, 19]]}
  body: {lower: 1, seeds_mm: [[0, 0, 40]]}
"""


@pytest.fixture(scope="module")
def python(tmp_path_factory):
    """Run Python without any package of ROS; the finished process."""
    folder = tmp_path_factory.mktemp("blocked")
    (folder / "sitecustomize.py").write_text(BLOCK)
    place = os.pathsep.join([str(folder), os.environ["PYTHONPATH"]])

    def run(*words):
        return subprocess.run(
            [sys.executable, *map(str, words)],
            env=os.environ | {"PYTHONPATH": place},
            capture_output=True,
            text=True,
            check=False,
        )

    return run


def last_line(ran):
    """What a program printed at last, which has worked."""
    assert ran.returncode == 0, ran.stderr
    return ran.stdout.splitlines()[-1]


@pytest.mark.slow
def test_only_nodes_and_what_looks_at_them_import_ros(python):
    needs = set(json.loads(last_line(python("-c", IMPORTS, json.dumps(ROS)))))
    assert "us_sim.nodes.probe_tracker" in needs
    rooms = ("us_sim.nodes.", "us_sim.viewer.", "us_sim.evaluation.latency.arrivals")
    needs.discard("us_sim.run.preloaded")  # where nodes are forked
    assert not [name for name in needs if not name.startswith(rooms)]
    assert not needs & {"us_sim.nodes.settings", "us_sim.nodes.topics"}


@pytest.mark.slow
def test_an_environment_is_scanned(python, small_scene):
    grey, force = map(float, last_line(python("-c", SCAN, small_scene)).split())
    assert grey > 10
    assert force > 0.5  # N


@pytest.mark.slow
def test_commands_on_files_do_their_work(python, tmp_path, small_scene):
    session, folder = write(tmp_path / "s.mcap", press(30)), tmp_path / "made"
    folder.mkdir()
    grey = np.random.default_rng(1).integers(60, 120, (30, 20, 25), dtype=np.uint8)
    grey[13:17, :, 8:11] = 10  # a vein along y
    grid = np.diag([2e-3, 2e-3, 2e-3, 1.0])
    grid[:3, 3] = [-0.03, -0.02, 0.0]
    volume, sweep = tmp_path / "volume.nrrd", tmp_path / "sweep.mha"
    write_volume(volume, Volume(grey, grid))
    matrices = np.tile(np.diag([1e-3, 1e-3, 1e-3, 1.0]), (12, 1, 1))
    matrices[:, 2, 3] = 1e-3 * np.arange(12)
    write_sweep(sweep, grey[:12], matrices)
    points, seeds = tmp_path / "points.csv", tmp_path / "seeds.yaml"
    markers = ROOT / "config" / "markers" / "board.yaml"
    points.write_text("name,x,y,z\na,0,0,0\nb,9,0,0\nc,0,9,0\nd,0,0,9\n")
    seeds.write_text(SEEDS)
    words = {
        "bag info": ["bag", "info", session],
        "bag check": ["bag", "check", session],
        "bag extract": ["bag", "extract", session, "--out", folder / "x", "--poses", "--images"],
        "score": ["score", session, "--out", folder / "score"],
        "reconstruct": ["reconstruct", sweep, "--out", folder / "r.nrrd", "--spacing", "1 mm"],
        "import": ["import", volume, "--out", folder / "case"],
        "segment": ["segment", folder / "case", "--seeds", seeds],
        "cases": ["cases", folder],
        "calibrate": ["calibrate", "landmarks", points, points, "--out", folder / "to.yaml"],
        "print-marker": ["print-marker", markers, "--out", folder / "marker.png"],
        "reference": ["reference", "--out", folder / "reference.md"],
        "run --dry-run": ["run", small_scene, "--dry-run"],
    }
    lines = [[str(word) for word in line] for line in words.values()]
    statuses = json.loads(last_line(python("-c", COMMANDS, json.dumps(lines))))
    assert dict(zip(words, statuses, strict=True)) == dict.fromkeys(words, 0)
    reference = ROOT / "docs" / "reference.md"
    assert (folder / "reference.md").read_text() == reference.read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ["us_sim", "run", "SCENE"],
        ["us_sim", "view", "--attach"],
        ["us_sim", "play", "press_and_slide.mcap"],
        ["us_sim", "evaluate", "latency", "--quick", "--out", "OUT"],
        ["us_sim.nodes.probe_tracker", "--ros-args", "-p", "scene:=SCENE"],
        ["us_sim.viewer.viewer"],
    ],
    ids=" ".join,
)
def test_what_needs_rclpy_says_how_to_get_it(python, words, small_scene, tmp_path):
    for name, path in {"SCENE": small_scene, "OUT": tmp_path / "out"}.items():
        words = [word.replace(name, str(path)) for word in words]
    ran = python("-m", *words)
    said = [line for line in ran.stderr.splitlines() if "rclpy" in line]
    assert ran.returncode == 1, ran.stderr
    assert len(said) == 1, ran.stderr
    assert "rclpy is not installed: on Linux x86-64 `pip install .` brings it" in said[0]
    assert "Traceback" not in ran.stderr
