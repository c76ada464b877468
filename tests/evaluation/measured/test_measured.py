"""`us-sim evaluate measured`: studies whose data are there, and those whose are not."""

import csv

import pytest

from us_sim.errors import UsSimError
from us_sim.evaluation.measured import report
from us_sim.evaluation.measured.study import Finding, Section, Study
from us_sim.evaluation.settings import MeasuredData


def _study(name, folder, found):
    def measure(data, made):
        made.picture(name).touch()
        found.append((data, made.report.parent, made.quick))
        main = Finding(name, "a case", "depth", "mm", 2.0, 2.5)
        return Section(
            f"About {name}", "text", [main, Finding(name, "layer", "depth", "mm", headline=False)]
        )

    return Study(name, folder, f"https://example.org/{name}@1", "MIT", "By A.", measure)


@pytest.fixture
def found(monkeypatch):
    """Calls of the studies `gel` and `steel`, of which each has a folder."""
    calls = []
    studies = (_study("gel", "gel-data", calls), _study("steel", "steel-data", calls))
    monkeypatch.setattr(report, "STUDIES", studies)
    monkeypatch.delenv("US_SIM_TEST_DATA", raising=False)
    return calls


def test_studies_without_data_are_left_out_and_say_from_where_to_fetch_them(tmp_path, found):
    data, out = tmp_path / "data", tmp_path / "out"
    (data / "gel-data").mkdir(parents=True)
    assert report.evaluate_measured(out, True, MeasuredData(data=data)) == 0
    assert found == [(data / "gel-data", out, True)]
    row, layer = csv.DictReader((out / "measured.csv").open())
    assert (row["study"], row["measured"], row["predicted"]) == ("gel", "2", "2.5")
    text = (out / "measured.md").read_text()
    assert "a case" in text
    assert layer["case"] == "layer"
    assert "layer" not in text
    left_out = text[text.index("## Left out") :]
    assert "https://example.org/steel@1" in left_out
    assert "gel" not in left_out


@pytest.mark.parametrize("named", [True, False])
def test_no_data_at_all_is_refused_before_anything_is_written(tmp_path, found, monkeypatch, named):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsSimError, match="gel-data, steel-data"):
        report.evaluate_measured(
            tmp_path / "out", True, MeasuredData(data=tmp_path if named else None)
        )
    assert not found
    assert not (tmp_path / "out").exists()
