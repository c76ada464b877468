"""The command's error paths: one sentence, status 1, no traceback."""

import pytest

from us_sim.command.main import main


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["run", "nowhere"], "there is no scene file nowhere; installed scenes are"),
        (["run", "upper_arm", "--duration", "-1"], "--duration -1: must be more than 0 seconds"),
        (["run", "upper_arm", "--dry-run", "--param", "x"], "--param x: write NODE.NAME=VALUE"),
        (
            ["run", "upper_arm", "--dry-run", "--param", "skin.a=1"],
            "--param skin: this scene does not run such a node",
        ),
        (["run", "upper_arm", "--record", "a.bag"], "--record a.bag: must be a file that ends"),
        (["run", "upper_arm", "--record", "/"], "--record /: must be a file that ends in .mcap"),
        (["play", "press_and_slide.mcap", "--rate", "-1"], "--rate -1: must be from 0.01 to 100"),
        (["play", "press_and_slide.mcap", "--rate", "inf"], "--rate inf: must be from"),
        (["run", "liver_sweep", "--dry-run"], "volume.file: is missing"),
        (["run", "upper_arm", "--path", "nowhere.mcap"], "nowhere.mcap"),
        (["bag", "info", "nowhere.mcap"], "nowhere.mcap"),
        (["play", "nowhere.mcap"], "nowhere.mcap"),
        (["demo", "upper_arm", "--volume", "nowhere.mha"], "there is no file"),
    ],
)
def test_bad_input_is_one_sentence(args, words, capsys):
    assert main(args) == 1
    error = capsys.readouterr().err
    assert words in error
    assert error.startswith("us-sim: ")
    assert error.count("\n") == 1


def test_bag_info_lists_the_demos_path(capsys):
    from us_sim.share import shared_path

    assert main(["bag", "info", str(shared_path("bags/press_and_slide.mcap"))]) == 0
    text = capsys.readouterr().out
    assert "/tracker/pose" in text
    assert "600" in text
