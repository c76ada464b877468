"""`us-sim evaluate measured`: studies whose data are there, and those whose are not."""

import csv

import pytest

from us_sim.errors import UsSimError
from us_sim.evaluation.measured import report
from us_sim.evaluation.measured.report import MEASURED, Study
from us_sim.evaluation.settings import MeasuredData
from us_sim.evaluation.subject import Piece


def _study(name, folder):
    def plan(data, quick):
        row = {"case": str(data), "quantity": "depth", "unit": "mm", "measured": 2.0, "x": quick}
        return [Piece({"study": name}, lambda: [row])]

    return Study(folder, plan, lambda rows: (f"{name}: {len(rows)} row.", {}))


@pytest.fixture(autouse=True)
def _studies(monkeypatch):
    studies = {"gel": _study("gel", "gel-data"), "steel": _study("steel", "steel-data")}
    monkeypatch.setattr(report, "STUDIES", studies)
    monkeypatch.delenv("US_SIM_TEST_DATA", raising=False)


def test_studies_without_data_are_left_out_and_named(tmp_path):
    data, out = tmp_path / "data", tmp_path / "out"
    (data / "gel-data").mkdir(parents=True)
    assert MEASURED(out, True, MeasuredData(data=data)) == 0
    (row,) = csv.DictReader((out / "measured.csv").open())
    assert list(row) == ["study", *report.COLUMNS]
    assert (row["study"], row["case"], row["measured"]) == ("gel", str(data / "gel-data"), "2")
    text = (out / "measured.md").read_text()
    assert "- gel: 1 row." in text
    assert "not there: steel" in text


def test_a_folder_without_data_is_refused(tmp_path):
    with pytest.raises(UsSimError, match="gel-data, steel-data"):
        MEASURED(tmp_path / "out", True, MeasuredData(data=tmp_path))
