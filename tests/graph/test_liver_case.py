"""From a real sweep to pressing on it: the README's three commands."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from us_sim.recording.path import write_path
from us_sim.recording.press_and_slide import make_press_and_slide
from us_sim.volume.cases.case import read_case


def run(folder, *words):
    """The output of a command."""
    command = [sys.executable, "-m", "us_sim", *map(str, words)]
    made = subprocess.run(command, capture_output=True, text=True, cwd=folder, env=os.environ)
    assert made.returncode == 0, made.stderr[-2000:]
    assert "Traceback" not in made.stderr
    return made.stdout


@pytest.fixture(scope="module")
def case(shared_data, tmp_path_factory):
    """The liver sweep, reconstructed coarsely and segmented."""
    sweep = shared_data / "imfusion-liver-sweep" / "liver_sweep.igs.mha"
    folder = tmp_path_factory.mktemp("liver")
    made = ["--spacing", "1 mm"]
    assert "140 frames" in run(folder, "reconstruct", sweep, "--out", "cases/liver", *made)
    run(folder, "segment", "cases/liver", "--seeds", "liver_sweep")
    return folder / "cases" / "liver"


def test_the_case_has_two_veins_and_a_probe_and_no_name_of_the_sweep(case):
    opened = read_case(case)
    assert set(opened.settings.structures) == {"vena cava", "portal vein"}
    assert {file.stem for file in (case / "surfaces").iterdir()} == {"vena cava", "portal vein"}
    assert opened.settings.probe.geometry == "convex"
    # The array that made the sweep, as its header has it.
    array = opened.settings.probe.array.given
    assert array.radius == pytest.approx(50.79e-3, abs=5e-4)
    assert array.depth == pytest.approx(0.177, abs=5e-3)
    start, scanned = opened.settings.start, opened.settings.scanned
    assert (start.position, start.orientation) in [(p.position, p.orientation) for p in scanned]
    assert "igs" not in (case / "case.yaml").read_text()


def test_its_vessels_deform_when_it_is_pressed(case, tmp_path):
    path = tmp_path / "press.mcap"
    write_path(path, make_press_and_slide(rate=15.0, duration=3.0, depth=0.02), sidecar=False)
    said = run(tmp_path, "demo", "--case", case, "--path", path, "--out", "press")
    assert "images out" in said
    areas = json.loads((tmp_path / "press" / "summary.json").read_text())["areas"]
    (vein, *_) = (np.array(area) for key, area in areas.items() if key.endswith("_mm2"))
    assert vein[0] > 20.0
    pressed = np.abs(vein / vein[0] - 1.0)[np.array(areas["depth_mm"]) > 15.0]
    assert pressed.max() > 0.05
    with Image.open(tmp_path / "press" / "contact_sheet.png") as sheet:
        pixels = np.asarray(sheet.convert("RGB")).astype(int)
    outlines = (pixels[..., 2] > pixels[..., 0] + 80) & (pixels[..., 2] > 150)
    assert outlines[: len(pixels) * 2 // 3].sum() > 100  # of the veins, in the images
