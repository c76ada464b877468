"""`us-sim evaluate tissue` in small: its measures, its files, and its sentences when it cannot."""

import csv
import re
import sys
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import us_sim
from us_sim.command.main import main
from us_sim.evaluation.subject import Piece
from us_sim.evaluation.tissue import report as tissue
from us_sim.evaluation.tissue.cases import SCENES
from us_sim.evaluation.tissue.measure import PathOutcome, TissueBench, compare_outcomes
from us_sim.evaluation.tissue.report import TISSUE
from us_sim.tissue.mesh.tetrahedral_mesh import signed_volumes

COLUMNS = {
    *("scene", "method", "nodes", "tets", "threads", "setting", "ms_median", "ms_p99"),
    *("rel_l2_error", "max_error_mm", "force_error", "volume_error", "estimated_error"),
}
PRESS = SCENES["press_25mm"]


def test_errors_of_a_known_field_are_what_they_are_by_hand():
    model = PRESS.make_model((5, 4, 4))
    nodes = model.mesh.nodes
    exact = PathOutcome(nodes * [0, 0, -0.1], -4.0, 0.0018)
    wrong = nodes * [0, 0, -0.1]
    wrong[7] += [0.003, 0.0, 0.004]
    found = PathOutcome(
        wrong, -5.0, signed_volumes(nodes * [1, 1, 1.2], model.mesh.tetrahedra).sum()
    )
    errors = compare_outcomes(found, exact, 0.002)
    assert errors["rel_l2_error"] == pytest.approx(0.005 / np.linalg.norm(0.1 * nodes[:, 2]))
    assert errors["max_error_mm"] == pytest.approx(5.0)
    assert errors["force_error"] == pytest.approx(0.25)
    assert errors["volume_error"] == pytest.approx((0.0024 - 0.0018) / 0.002)


@pytest.fixture
def small(monkeypatch, tmp_path):
    """A subject of two methods on a small mesh, one of which fails, against a coarse reference."""
    monkeypatch.setenv("US_SIM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(tissue, "_NODES", 7 * 4 * 4)

    def pieces(_quick):
        bench = TissueBench()

        def trial(method, setting):
            case = {"scene": PRESS.name, "method": method, "nodes": 112, "tets": 270}
            case |= {"threads": 1, "setting": str(setting) if setting else "default"}
            return Piece(case, partial(bench.run_method, PRESS, (7, 4, 4), method, setting))

        solve = partial(bench.measure_reference, PRESS, (0.03, 0.025))
        trials = [trial("fem_cg", {}), trial("fem_cg", {"iterations": -1}), trial("fem", {})]
        return {"references": [Piece({"scene": PRESS.name}, solve)], "tissue": trials}

    return replace(TISSUE, pieces=pieces)


@pytest.mark.slow
def test_rows_pictures_and_report_are_there_and_a_failure_is_named(small, tmp_path, capsys):
    out = tmp_path / "out"
    assert small(out, quick=True) == 1
    assert "iterations: -1 is outside" in capsys.readouterr().out
    rows = list(csv.DictReader((out / "tissue.csv").read_text(encoding="utf-8").splitlines()))
    assert rows[0].keys() == COLUMNS | {"failure"}
    assert [row["method"] for row in rows] == ["fem_cg", "fem", "fem_cg"]
    assert 0.05 < float(rows[0]["rel_l2_error"]) < 0.5
    assert 0.2 < float(rows[1]["rel_l2_error"]) < 0.5
    text = (out / "tissue.md").read_text(encoding="utf-8")
    assert "- `fem` is " in text
    pictures = re.findall(r"!\[.+?\]\((.+?)\)", text)
    assert len(pictures) == 2
    for name in pictures:
        assert (out / name).read_bytes().startswith(b"\x89PNG")


def test_a_report_is_not_overwritten(tmp_path, capsys):
    report = tmp_path / "tissue.md"
    report.write_text("measured for hours", encoding="utf-8")
    assert main(["evaluate", "tissue", "--quick", "--out", str(tmp_path)]) == 1
    assert "choose another folder with --out" in capsys.readouterr().err
    assert report.read_text(encoding="utf-8") == "measured for hours"


def test_without_scikit_fem_the_extra_is_named(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "skfem", None)
    monkeypatch.setattr(us_sim, "evaluation", us_sim.evaluation)  # put back when this is over
    for name in [name for name in sys.modules if name.startswith("us_sim.evaluation")]:
        monkeypatch.delitem(sys.modules, name)
    assert main(["evaluate", "tissue", "--quick", "--out", str(tmp_path)]) == 1
    error = capsys.readouterr().err
    assert "pip install 'us_sim[evaluate]'" in error
    assert error.count("\n") == 1
