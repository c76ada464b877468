"""`us-sim press` from a scene to a table and a picture."""

import csv

import pytest

from us_sim.command.main import main


def test_a_press_of_a_scene_to_a_force_is_told_label_by_label(small_scene, tmp_path):
    out = tmp_path / "curve.csv"
    words = ["press", str(small_scene), "--force", "1 N", "--solver", "fem", "--out", str(out)]
    assert main(words) == 0
    with out.open(encoding="utf-8") as file:
        rows = [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]
    assert rows[-1]["force_n"] == pytest.approx(1.0, rel=2e-3)
    assert rows[0]["force_n"] == 0.0 < rows[-2]["force_n"] < rows[-1]["force_n"]
    assert rows[-1]["mean_strain_fat_percent"] < rows[-1]["mean_strain_bone_percent"] <= 0.1
    assert rows[-1]["most_strain_fat_percent"] < rows[-1]["mean_strain_fat_percent"]
    assert out.with_suffix(".png").stat().st_size > 10_000
    assert main(words) == 1  # it is there


def test_a_place_beside_the_tissue_is_said(small_scene, tmp_path, capsys):
    out = str(tmp_path / "curve.csv")
    words = ["press", str(small_scene), "--at", "0.5", "0.5", "--solver", "fem", "--out", out]
    words += ["--deepest", "3 mm"]
    assert main(words) == 1
    assert "above" in capsys.readouterr().err
