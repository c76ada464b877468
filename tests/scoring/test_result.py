"""Results of attempts: written and read, as pages and as the table of a class."""

import json

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from us_sim.errors import ScoreError
from us_sim.scoring.class_table import tabulate_results, write_class_table
from us_sim.scoring.exercise import Step
from us_sim.scoring.live import Score
from us_sim.scoring.metrics import Metric
from us_sim.scoring.result import (
    classify_attempt,
    render_page,
    select_plain_metrics,
)
from us_sim.scoring.result_place import KEPT_FOLDER, ResultPlace, read_results


def result(student="Ada", begun="2026-11-29T07:07:21+00:00", done=2, **more):
    states = ["done" if k < done else "missed" for k in range(3)]
    return {
        "name": "Compression <of> the vein",
        "description": "Compress the vein.",
        "scene": "arm",
        "state": "passed" if done == 3 else "not passed",
        "seconds": 12.0,
        "about": {"student": student, "begun": begun, "checksum": "abc", "changed": ""},
        "plain": {"Time, s": "12", "Highest force, N": "9.81", "Points right, of 3": str(done)},
        "steps": [{"what": f"point {k}", "state": s, "seen": "x"} for k, s in enumerate(states)],
        "faults": [{"seconds": 3.5, "what": "slid"}],
        "metrics": {"Path Length, mm": "60", "Smallest Area of vein, mm^2": "1"},
        **more,
    }


def test_the_five_plain_metrics_come_first():
    metrics = [
        Metric("Path Length", "mm", 1234.5),
        Metric("Peak Probe Force", "N", 9.8765),
        Metric("Time above 20 N", "s", 0.25),
    ]
    score = Score(metrics, [Step("a", True, ""), Step("b", False, "")], (), 52.21)
    assert [(each.label, each.format(3)) for each in select_plain_metrics(score, 20.0)] == [
        ("Time, s", "52.2"),
        ("Highest force, N", "9.88"),
        ("Time above 20 N, s", "0.25"),
        ("Way of the probe, mm", "1.23e+03"),
        ("Points right, of 2", "1"),
    ]
    assert np.isnan(select_plain_metrics(Score([]), 20.0)[0].value)


@pytest.mark.parametrize(
    ("score", "void", "state"),
    [
        (Score([], was_in_air=False), "", "to lift"),
        (Score([]), "", "to do"),
        (Score([], [Step("a", True, "")], seconds=1.0), "", "running"),
        (Score([], [Step("a", True, "")], seconds=1.0, has_ended=True), "", "passed"),
        (Score([], [Step("a", False, "")], seconds=1.0, has_ended=True), "", "not passed"),
        (Score([]), "why", "void"),
    ],
)
def test_what_became_of_an_attempt(score, void, state):
    assert classify_attempt(score, void) == state


def test_a_page_has_all_and_no_markup_of_a_name():
    page = render_page(result(), b"\x89PNG")
    assert "<h1>Compression &lt;of&gt; the vein</h1><h2>Not passed</h2>" in page
    assert all(word in page for word in ("9.81", "slid", "iVBORw==", "<summary>More", "Ada"))


@given(st.text(max_size=30))
def test_any_name_is_written_and_read_again(tmp_path_factory, student):
    folder = tmp_path_factory.mktemp("class")
    files = ResultPlace(str(folder)).write(result(student), b"")
    assert [file.rpartition(".")[2] for file in files] == ["html", "json"]
    assert read_results(str(folder)) == [json.loads(json.dumps(result(student)))]


def test_results_go_to_any_address_of_fsspec():
    fsspec = pytest.importorskip("fsspec")
    address = "memory://class/of/1"
    place = ResultPlace(address)
    place.try_out()
    place.write(result(), b"")
    place.write(result("Bob", "2026-11-29T07:00:00+00:00"), b"")
    assert [each["about"]["student"] for each in read_results(address)] == ["Bob", "Ada"]
    assert len(fsspec.filesystem("memory").ls("/class/of/1")) == 4


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"name": "x"}'])
def test_what_is_no_result_is_refused_with_its_name(tmp_path, text):
    (tmp_path / "other.json").write_text(text)
    with pytest.raises(ScoreError, match=r"other\.json"):
        read_results(str(tmp_path))
    with pytest.raises(ScoreError, match="no result"):
        read_results(str(tmp_path / "nowhere"))


@pytest.mark.parametrize("address", ["file", "nothing-known://class"])
def test_a_place_that_cannot_be_written_is_found_at_once(tmp_path, monkeypatch, address):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(ScoreError, match=f"{address}: cannot be written"):
        ResultPlace(address).try_out()


def test_a_place_that_was_tried_out_is_empty(tmp_path):
    ResultPlace(str(tmp_path / "class")).try_out()
    assert not any((tmp_path / "class").iterdir())


def test_results_that_a_place_refuses_are_kept_until_it_takes_them(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "class").write_text("no folder")
    place = ResultPlace(str(tmp_path / "class"))
    for student in ("Ada", "Bob"):
        with pytest.raises(ScoreError, match=f"cannot be written.*{KEPT_FOLDER}/{student}.*html"):
            place.write(result(student), b"")
    with pytest.raises(ScoreError, match=r"cannot be written.*Ada.*html"):
        place.write_kept()
    assert len(read_results(KEPT_FOLDER)) == 2
    (tmp_path / "class").unlink()
    assert len(place.write_kept()) == 4
    assert place.write_kept() == []
    assert len(read_results(str(tmp_path / "class"))) == 2
    assert not any((tmp_path / KEPT_FOLDER).iterdir())


def test_the_table_of_a_class_has_a_row_for_each_attempt(tmp_path):
    begun = [f"2026-11-29T07:0{k}:00+00:00" for k in range(3)]
    results = [result("Ada", begun[0], 1), result("Bob", begun[1], 3), result("Ada", begun[2], 3)]
    for each, checksum in zip(results, ("a1b2", "a1b2", "ffff"), strict=True):
        each["about"] |= {"checksum": checksum}
    table = tabulate_results(results)
    assert list(table["checksum"]) == ["a1b2", "a1b2", "ffff, unlike most"]
    csv, page = write_class_table(table, tmp_path / "out")
    kept = pd.read_csv(csv)
    assert list(kept["student"]) == ["Ada", "Bob", "Ada"]
    assert list(kept["right"]) == [1, 3, 3]
    assert list(kept["Highest force, N"]) == [9.81] * 3
    text = page.read_text()
    assert "2 students, 1 exercises, 3 attempts, 2 of them passed." in text
    assert "Compression &lt;of&gt; the vein" in text
    assert "data:image/png" in text


def test_who_does_an_edited_exercise_more_often_does_not_outvote_the_class():
    results = [result(name) for name in ("Ada", "Bob", "Mal", "Mal", "Mal")]
    for each in results:
        each["about"]["checksum"] = "ffff" if each["about"]["student"] == "Mal" else "a1b2"
    found = tabulate_results(results)["checksum"]
    assert list(found) == ["a1b2"] * 2 + ["ffff, unlike most"] * 3
