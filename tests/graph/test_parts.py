"""A part that a scene does not name costs nothing: no process, no module, no topic."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from command import us_sim

from us_sim.recording.reader import read_bag

AT_EXIT = """
import json, os, pathlib, sys

end = os._exit  # by which a process that was forked ends

def write(status):
    names = [name for name in sys.modules if name.startswith("us_sim.")]
    folder = pathlib.Path(os.environ["MODULES_OF_PROCESSES"])
    part = folder / f"{os.getpid()}.part"
    part.write_text(json.dumps([sys.argv[0], names]))
    part.rename(part.with_suffix(".json"))  # one that is ended meanwhile has said nothing
    end(status)

if "MODULES_OF_PROCESSES" in os.environ:
    os._exit = write
"""


def run_and_list_modules(scene: Path, tmp_path: Path) -> tuple[dict[str, set[str]], set[str]]:
    """Modules of us_sim by node, and topics recorded, of a run of the scene along its path."""
    (tmp_path / "sitecustomize.py").write_text(AT_EXIT)
    modules = tmp_path / "modules"
    modules.mkdir()
    search = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"PYTHONPATH": search, "MODULES_OF_PROCESSES": str(modules)}
    path = yaml.safe_load(scene.read_text())["path"]
    recording = tmp_path / "session.mcap"
    result = us_sim("run", scene, "--record", recording, "--path", path, env=environment)
    assert result.returncode == 0, result.stderr
    by_node = {}
    for file in modules.glob("*.json"):
        program, names = json.loads(file.read_text())
        by_node[Path(program).stem] = set(names)
    return by_node, {topic.name for topic in read_bag(recording).topics}


@pytest.fixture(scope="module")
def said() -> set[str]:
    """Modules that describe scenes and compute nothing, since every node reads the scene."""
    program = "import sys, us_sim.scene.scene; print(*sys.modules)"
    names = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True).stdout
    assert not {"numba", "scipy"} & set(names.split())
    return set(names.split())


def imports(modules: set[str], package: str) -> bool:
    return any(name.startswith(f"us_sim.{package}.") for name in modules)


@pytest.mark.parametrize("left_out", ["skin", "tissue"])
def test_what_a_scene_leaves_out_is_not_started_imported_or_published(
    played_scene, left_out, said, tmp_path
):
    document = yaml.safe_load(played_scene.read_text())
    del document[left_out]
    scene = tmp_path / "scene.yaml"
    scene.write_text(yaml.safe_dump(document))
    by_node, topics = run_and_list_modules(scene, tmp_path)
    nodes = {"probe_tracker", "slice_interpolator", "session_recorder", "path_player"}
    nodes |= {"tissue_deformer"} if left_out == "skin" else {"skin_deformer"}
    assert set(by_node) == nodes
    for node, modules in by_node.items():
        modules -= said
        assert imports(modules, "tissue") == (node == "tissue_deformer"), node
        assert imports(modules, "skin") == (node == "skin_deformer"), node
        assert ("us_sim.slicing.b_mode" in modules) == (node == "slice_interpolator"), node
    assert "/ultrasound/image" in topics
    assert not any(topic.startswith(f"/{left_out}/") for topic in topics)
