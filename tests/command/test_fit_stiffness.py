"""`us-sim fit-stiffness` from a recording to a scene, and recordings that will not do."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from wrench_files import WrenchRecord, write_wrenches

from us_sim.command.main import main
from us_sim.recording.path import ProbePath, write_poses
from us_sim.recording.press_and_slide import make_press_and_slide
from us_sim.recording.writer import BagWriter
from us_sim.scene.building import build_materials, build_tissue_model, load_volume
from us_sim.scene.reading import load_scene
from us_sim.settings.reading import SettingsReader
from us_sim.tissue.stiffness_fit import simulate_wrenches
from us_sim.volume.cases.settings import CaseSettings
from us_sim.volume.cases.writing import new_case, write_case_settings
from us_sim.volume.files.writing import write_volume
from us_sim.volume.volume import Volume


def felt_in(source, name, modulus, path) -> np.ndarray:
    """The wrenches (K, 6) of a press of a scene, one of whose structures has another modulus."""
    scene = load_scene(str(source))
    volume = load_volume(scene)
    model = build_tissue_model(scene, volume)
    given = dict(scene.tissue.materials)
    given[name] = replace(given[name], young_modulus=modulus)
    model = replace(model, materials=build_materials(scene, given, model.mesh, volume))
    wrenches = simulate_wrenches(model, path.poses, path.positions[:, 2])
    return wrenches + np.random.default_rng(3).normal(scale=0.005, size=wrenches.shape)


def session(folder: Path, path: ProbePath, wrenches: WrenchRecord | None) -> str:
    folder.mkdir()
    with BagWriter(folder / "session.mcap") as writer:
        write_poses(writer, path)
        if wrenches is not None:
            write_wrenches(writer, wrenches)
    return str(folder / "session.mcap")


def record_of(path, wrenches, frame="probe") -> WrenchRecord:
    return WrenchRecord("/probe/wrench", frame, path.stamps, wrenches)


@pytest.mark.parametrize(
    ("spoil", "word"),
    [
        (lambda path, _: (path, None), "probe/wrench"),
        (lambda path, felt: (path, record_of(path, felt, "flange")), "'flange'"),
        (lambda path, felt: (replace(path, frame_id="camera"), record_of(path, felt)), "--pose"),
        (lambda path, felt: (path, record_of(path, np.full_like(felt, np.nan))), "finite"),
    ],
    ids=["no wrench", "other frame", "other pose frame", "no numbers"],
)
def test_what_is_no_press_is_one_sentence(small_scene, tmp_path, capsys, spoil, word):
    path = replace(make_press_and_slide(rate=4.0, duration=10.0), topic="/probe/pose")
    wrenches = np.random.default_rng(0).normal(size=(len(path), 6))
    recording = session(tmp_path / "bag", *spoil(path, wrenches))
    out = tmp_path / "fitted.yaml"
    assert main(["fit-stiffness", str(small_scene), recording, "--out", str(out)]) == 1
    error = capsys.readouterr().err
    assert error.startswith("us-sim: ")
    assert word in error
    assert "Traceback" not in error
    assert not list(tmp_path.glob("*fitted*"))


@pytest.mark.slow
def test_the_moduli_of_a_case_are_found_from_its_press(tmp_path):
    grid = np.diag([2e-3, 2e-3, 2e-3, 1.0])
    grid[:3, 3] = [-0.04, -0.03, 0.0]
    grey = np.random.default_rng(1).integers(60, 120, (40, 30, 25), dtype=np.uint8)
    case = tmp_path / "gel"
    probe = {"aperture": "30 mm", "depth": "40 mm"}
    probe["collider"] = {"shape": "sphere", "radius": "30 mm"}
    given = {"name": "gel", "start": {}, "probe": probe, "around": {"young_modulus": 7e3}}
    with new_case(case) as folder:
        write_volume(folder / "volume.nrrd", Volume(grey, grid))
        write_case_settings(
            folder, SettingsReader("case.yaml").read(CaseSettings, given | {"nodes": 500})
        )
    path = replace(make_press_and_slide(rate=4.0, depth=0.006), topic="/probe/pose")
    wrenches = felt_in(f"case:{case}", "tissue", 11e3, path)
    recording = session(tmp_path / "bag", path, record_of(path, wrenches))
    out = tmp_path / "fitted.yaml"
    words = ["fit-stiffness", recording, "--case", str(case), "--out", str(out), "--poses", "12"]
    assert main(words) == 0
    scene = load_scene(out)
    assert scene.volume.case == str(case)
    assert scene.tissue is not None
    assert scene.tissue.materials["tissue"].young_modulus == pytest.approx(11e3, rel=0.03)
