"""The README and the pages beside it: commands, keys and links exist, and its code works."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from bench import Bench
from geometry_msgs.msg import PoseStamped

from us_sim.command.main import main
from us_sim.errors import SceneError
from us_sim.nodes.probe_tracker import ProbeTracker
from us_sim.scene.reading import merge_documents
from us_sim.scene.scene import Scene
from us_sim.scoring.exercise import Exercise
from us_sim.settings.reading import SettingsReader
from us_sim.settings.tables import make_anchor
from us_sim.volume.segmentation.settings import SegmentationSettings

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
WRITTEN = [page for page in PAGES if page.name != "reference.md"]
README = (ROOT / "README.md").read_text(encoding="utf-8")
GROUPS = ("bag", "calibrate", "evaluate", "param")
"""Commands that are followed by another."""


def names(pages):
    return [str(page.relative_to(ROOT)) for page in pages]


def commands_on(page):
    """Each `us-sim` command on a page, in words."""
    text = page.read_text(encoding="utf-8")
    found = re.findall(r"(?:`|&& |^)(us-sim [a-z][^`\n|&#]*)", text, re.MULTILINE)
    return sorted({tuple(shlex.split(command)[1:]) for command in found})


@pytest.mark.parametrize("page", WRITTEN, ids=names(WRITTEN))
def test_every_command_and_option_exists(page, capsys):
    for words in commands_on(page):
        verbs = words[: 2 if words[0] in GROUPS and words[1:] else 1]
        with pytest.raises(SystemExit) as ended:
            main([*verbs, "--help"])
        assert ended.value.code == 0, words
        help_text = capsys.readouterr().out
        for option in (word.strip("[]") for word in words if word.strip("[").startswith("--")):
            assert option in help_text, words


@pytest.mark.parametrize("page", PAGES, ids=names(PAGES))
def test_every_link_leads_somewhere(page):
    text = page.read_text(encoding="utf-8")
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if link.startswith("http"):
            continue
        target, _, heading = link.partition("#")
        file = page.parent / target if target else page
        assert file.exists(), link
        if heading:
            titles = re.findall(r"^#+ (.+)$", file.read_text(encoding="utf-8"), re.MULTILINE)
            assert heading in map(make_anchor, titles), link


@pytest.mark.parametrize("page", WRITTEN, ids=names(WRITTEN))
def test_every_piece_of_a_scene_can_be_read(page):
    bare = {"name": "bare", "volume": {"phantom": "upper_arm"}}
    bare["probe"] = {"aperture": "40 mm", "depth": "40 mm"}
    arm = yaml.safe_load((ROOT / "config/scenes/upper_arm.yaml").read_text(encoding="utf-8"))
    for block in re.findall(r"^```yaml\n(.*?)^```", page.read_text(encoding="utf-8"), re.M | re.S):
        given = yaml.safe_load(block)
        if "task" in given:
            SettingsReader(str(page)).read(Exercise, given)  # and no scene
            continue
        base = arm if given.pop("based_on", None) or given.get("case") else bare
        if {"winkler", "udp"} & {str(word) for word in re.findall(r"\w+", block)}:
            continue  # what a package of others adds; see test_contributing
        if "phantom" not in given.get("volume", {"phantom": ""}):
            base = {key: value for key, value in base.items() if key != "volume"}
        structures = given.get("structures", {})
        if isinstance(structures, dict) and any("seeds_mm" in one for one in structures.values()):
            SettingsReader(str(page)).read(SegmentationSettings, given)  # seeds, and no scene
            continue
        document = merge_documents(base, given)
        if "structures" in document and isinstance(document["structures"], list):
            document["structures"] = {name: {} for name in document["structures"]}
        SettingsReader(str(page), error=SceneError).read(Scene, document)


@pytest.mark.slow
def test_the_readmes_script_runs_an_episode():
    (script,) = (c for c in re.findall(r"```python\n(.*?)```", README, re.S) if "rclpy" not in c)
    names: dict = {}
    exec(script, names)
    assert names["image"].shape == (256, 256, 1)
    assert names["image"].std() > 20
    assert names["success"]
    assert -1 < names["wrench"][2] <= 0  # N, of the tissue: the vein is let go


def pressed(poses):
    """The depths in the skin, m; above it the probe is before the first pose comes."""
    return {pose.pose.position.z for pose in poses if pose.pose.position.z > 0}


def test_the_readmes_node_moves_the_probe(tmp_path):
    (code,) = (c for c in re.findall(r"```python\n(.*?)```", README, re.S) if "rclpy" in c)
    file = tmp_path / "my_tracker.py"
    file.write_text(code)
    bench = Bench()
    try:
        bench.make(ProbeTracker, scene="upper_arm")
        poses = bench.collect(PoseStamped, "probe/pose")
        with subprocess.Popen([sys.executable, str(file)]) as node:
            try:
                bench.spin_until(lambda: len(pressed(poses)) >= 5)
            finally:
                node.kill()
    finally:
        bench.close()
    assert {pose.header.frame_id for pose in poses} == {"patient"}
    assert max(pressed(poses)) <= 0.005
