"""The README's examples work as they are written there."""

import re
import shlex
from pathlib import Path

import pytest

from us_sim.command.main import main

README = (Path(__file__).resolve().parents[1] / "README.md").read_text(encoding="utf-8")


def test_the_script_makes_an_image():
    scripts = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    (script,) = (script for script in scripts if "rclpy" not in script)  # see test_pages
    names: dict = {}
    exec(script, names)
    assert names["image"].shape == (512, 512)
    assert names["image"].std() > 20
    assert names["deformation"].force[2] < 0


VERBS = (
    *("demo", "run", "view", "render", "play", "bag", "info", "to-rerun"),
    *("evaluate", "tissue", "stability", "hand", "slice", "tracking", "latency", "image"),
    "measured",
    *("calibrate", "camera", "pivot", "landmarks", "probe", "time", "print-marker", "reference"),
    *("compile", "fit-stiffness", "reconstruct", "segment", "cases", "import"),
)

COMMANDS = sorted(
    {
        tuple(shlex.split(command)[1:])
        for command in re.findall(r"(?:`|&& |^)(us-sim [^`\n|&]*)", README, re.MULTILINE)
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
