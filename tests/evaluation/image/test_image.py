"""`evaluate image` in small: every artefact against its closed form."""

import csv

import numpy as np
import pandas as pd
import pytest

from us_sim.command.main import main
from us_sim.evaluation.image import report as image
from us_sim.evaluation.image.measure import make_row

ASKED = ["artefact", "probe", "tilt_deg", "depth_mm", "expected", "measured", "unit"]
ASKED += ["error_percent"]


def test_the_report_has_what_was_measured_and_says_what_broke(tmp_path, monkeypatch, capsys):
    def broken(quick):
        raise ArithmeticError(f"no closed form, quick {quick}")

    def even(quick):
        return [make_row("attenuation", "linear", 10.0, 0.02, 2.0, 2.05, "px")] if quick else []

    monkeypatch.setattr(image, "make_arm_images", lambda: {"arm": {"0°": np.eye(2)}})
    monkeypatch.setattr(image, "ARTEFACTS", {"shadow_edge": broken, "attenuation": even})
    assert main(["evaluate", "image", "--quick", "--out", str(tmp_path)]) == 1
    report = (tmp_path / "image.md").read_text(encoding="utf-8")
    assert "ArithmeticError: no closed form, quick True" in report
    assert "shadow_edge" in capsys.readouterr().out
    with (tmp_path / "image.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert list(rows[0])[: len(ASKED)] == ASKED
    assert rows[0]["error_percent"] == "5"


@pytest.mark.slow
@pytest.mark.parametrize("artefact", [name for name in image.ARTEFACTS if name != "run_time"])
def test_what_is_asked_of_an_artefact_is_met(artefact, monkeypatch):
    monkeypatch.setattr(image, "make_arm_images", lambda: {"arm": {"0°": np.eye(2)}})
    rows = [{"artefact": artefact, **row} for row in image.ARTEFACTS[artefact](True)]
    targets = [
        target
        for target in image.report_image(pd.DataFrame(rows)).targets
        if target.met is not None
    ]
    assert targets
    assert [target.quantity for target in targets if not target.met] == []
