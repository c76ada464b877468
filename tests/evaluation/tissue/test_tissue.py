"""`us-sim evaluate tissue` in small: its measures, its files, and its sentences when it cannot."""

import csv
import re
import sys

import numpy as np
import pytest

import us_sim
from us_sim.command.main import main
from us_sim.evaluation.block import MESHES
from us_sim.evaluation.tissue import reference as kept_reference
from us_sim.evaluation.tissue import report as tissue
from us_sim.evaluation.tissue.cases import SCENES
from us_sim.evaluation.tissue.measure import Outcome, Trial, compare
from us_sim.evaluation.tissue.report import evaluate_tissue
from us_sim.tissue.mesh.tetrahedral_mesh import signed_volumes

COLUMNS = (
    "scene,method,nodes,tets,threads,setting,ms_median,ms_p99,rel_l2_error,max_error_mm,"
    "force_error,volume_error,estimated_error,reference"
)
PRESS = SCENES["press_12mm"]


def test_errors_of_a_known_field_are_what_they_are_by_hand():
    model = PRESS.model((5, 4, 4))
    nodes = model.mesh.nodes
    exact = Outcome(nodes * [0, 0, -0.1], -4.0, 0.0018)
    wrong = nodes * [0, 0, -0.1]
    wrong[7] += [0.003, 0.0, 0.004]
    found = Outcome(wrong, -5.0, signed_volumes(nodes * [1, 1, 1.2], model.mesh.tetrahedra).sum())
    errors = compare(found, exact, 0.002)
    assert errors["rel_l2_error"] == pytest.approx(0.005 / np.linalg.norm(0.1 * nodes[:, 2]))
    assert errors["max_error_mm"] == pytest.approx(5.0)
    assert errors["force_error"] == pytest.approx(0.25)
    assert errors["volume_error"] == pytest.approx((0.0024 - 0.0018) / 0.002)


@pytest.fixture
def small(monkeypatch, tmp_path):
    """Two methods on a small mesh, one of which fails, against a coarse reference."""
    monkeypatch.setenv("US_SIM_CACHE", str(tmp_path / "cache"))
    counts = (7, 4, 4)
    trials = [
        Trial(PRESS, counts, "fem_cg", {"iterations": 40}, own=True),
        Trial(PRESS, counts, "fem_cg", {"iterations": -1}, own=True),
        Trial(PRESS, counts, "fem", {}, own=True),
    ]
    monkeypatch.setattr(tissue, "plan", lambda _quick: trials)
    monkeypatch.setattr(tissue, "_QUICK_SIZES", (0.03, 0.025))
    return tmp_path / "out"


@pytest.mark.slow
def test_rows_pictures_and_report_are_there_and_a_failure_is_named(small, capsys, monkeypatch):
    assert evaluate_tissue(small, quick=True) == 1
    said = capsys.readouterr().out
    assert "failed: fem_cg (iterations=-1)" in said
    lines = (small / "tissue.csv").read_text(encoding="utf-8").splitlines()
    assert lines[0] == COLUMNS
    rows = list(csv.DictReader(lines))
    assert [row["reference"].split(":")[0] for row in rows] == [
        "own equations",
        "nonlinear",
        "failed",
        "own equations",
        "nonlinear",
    ]
    assert {row["nodes"] for row in rows} == {str(7 * 4 * 4)}
    assert float(rows[3]["rel_l2_error"]) < 1e-6  # fem solves its equations exactly
    assert 0.01 < float(rows[4]["rel_l2_error"]) < 0.5
    text = (small / "tissue.md").read_text(encoding="utf-8")
    pictures = re.findall(r"!\[.+?\]\((.+?)\)", text)
    assert len(pictures) == 4
    for name in pictures:
        assert (small / name).read_bytes().startswith(b"\x89PNG")
        assert name in said
    assert "iterations: -1 is outside" in text

    # A second run takes the reference from the cache.
    monkeypatch.setattr(kept_reference, "solve_contact", None)
    assert evaluate_tissue(small.with_name("again"), quick=True) == 1


@pytest.mark.parametrize("subject", ["tissue", "stability", "slice", "tracking"])
def test_a_report_is_not_overwritten(subject, tmp_path, capsys):
    report = tmp_path / f"{subject}.md"
    report.write_text("measured for hours", encoding="utf-8")
    assert main(["evaluate", subject, "--quick", "--out", str(tmp_path)]) == 1
    error = capsys.readouterr().err
    assert error == f"us-sim: {report} exists already; choose another folder with --out\n"
    assert report.read_text(encoding="utf-8") == "measured for hours"
    assert list(tmp_path.iterdir()) == [report]


def test_without_scikit_fem_the_extra_is_named(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "skfem", None)
    monkeypatch.setattr(us_sim, "evaluation", us_sim.evaluation)  # put back when this is over
    for name in [name for name in sys.modules if name.startswith("us_sim.evaluation")]:
        monkeypatch.delitem(sys.modules, name)
    assert main(["evaluate", "tissue", "--quick", "--out", str(tmp_path)]) == 1
    error = capsys.readouterr().err
    assert "pip install 'us_sim[evaluate]'" in error
    assert error.count("\n") == 1
    assert MESHES[-1] == (32, 16, 16)
