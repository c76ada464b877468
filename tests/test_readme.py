"""The README's examples work as they are written there."""

import re
import shlex
from pathlib import Path

import pytest

from us_sim.command.main import main

README = (Path(__file__).resolve().parents[1] / "README.md").read_text(encoding="utf-8")


def test_the_script_runs_an_episode():
    scripts = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    (script,) = (script for script in scripts if "rclpy" not in script)  # see test_pages
    names: dict = {}
    exec(script, names)
    assert names["image"].shape == (256, 256)
    assert names["image"].std() > 20
    assert -8 < names["wrench"][2] < -4  # N, of the tissue against a press held at 6 N
    assert 0 < names["vein"] < 0.9


VERBS = (
    *("demo", "run", "view", "render", "play", "param"),
    *("bag", "info", "check", "diff", "extract", "to-rerun"),
    *("evaluate", "tissue", "stability", "hand", "slice", "tracking", "latency", "image"),
    "measured",
    *("calibrate", "camera", "pivot", "landmarks", "probe", "time", "print-marker", "reference"),
    *("dataset", "compile", "fit-stiffness", "reconstruct", "segment", "cases", "import"),
)

COMMANDS = sorted(
    {
        tuple(shlex.split(command)[1:])
        for command in re.findall(r"(?:`|&& |^)(us-sim [^`\n|&#]*)", README, re.MULTILINE)
    }
)


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_every_command_and_option_exists(words, capsys):
    verbs = [word for word in words[:2] if word in VERBS]
    with pytest.raises(SystemExit):
        main([*verbs, "--help"])
    help_text = capsys.readouterr().out
    for option in (word.strip("[]") for word in words if word.strip("[").startswith("--")):
        assert option in help_text


def test_pictures_are_there():
    for picture in re.findall(r"!\[[^\]]*\]\(([^)]+)\)", README):
        assert (Path(__file__).resolve().parents[1] / picture).is_file(), picture
