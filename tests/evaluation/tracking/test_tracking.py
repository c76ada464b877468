"""`evaluate tracking` in small: cases, errors and flips whose answers are known."""

import csv

import pytest

from us_sim.command.main import main
from us_sim.evaluation.tracking import report as tracking
from us_sim.evaluation.tracking.cases import CONDITIONS, RIGID_BODY, SINGLE, TrackingCase
from us_sim.evaluation.tracking.measure import TrackingBench

ASKED = [
    *("marker", "image_size", "distance_m", "angle_deg", "condition", "views", "detected"),
    *("flipped", "median_mm", "p95_mm", "median_deg", "p95_deg", "ms_median"),
]


@pytest.mark.slow
def test_the_rigid_body_is_tracked_as_well_as_asked():
    (row,) = TrackingBench().measure_case(TrackingCase(RIGID_BODY, "640x480", 0.4, 0.0), 4)
    assert row["detected"] == row["views"] == 20
    assert row["flipped"] == 0
    assert row["median_mm"] < 0.3
    assert row["p95_mm"] < 1.0
    assert row["median_deg"] < 0.2
    assert row["p95_deg"] < 0.6
    assert row["markers_used"] == 4


def test_a_hand_over_a_single_marker_makes_it_be_missed_and_nothing_worse():
    (row,) = TrackingBench().measure_case(
        TrackingCase(SINGLE, "640x480", 0.4, 30.0, "occlusion"), 2
    )
    assert row["views"] == 10
    assert row["detected"] < 10
    assert row["flipped"] == 0


@pytest.mark.slow
def test_the_report_and_its_rows_are_written(tmp_path, monkeypatch, capsys):
    few = [TrackingCase(name, "640x480", 0.4, 30.0) for name in (SINGLE, RIGID_BODY)]
    few += [TrackingCase(RIGID_BODY, "1920x1080", 0.4, 30.0)]
    few += [
        TrackingCase(SINGLE, "640x480", 0.4, 30.0, name) for name in CONDITIONS if name != "plain"
    ]
    monkeypatch.setattr(tracking, "list_cases", lambda _: few)
    monkeypatch.setattr(tracking, "_QUICK_SEQUENCES", {"640x480": 1, "1920x1080": 1})
    out = tmp_path / "report"
    assert main(["evaluate", "tracking", "--quick", "--out", str(out)]) == 0
    assert "single 40 mm marker" in capsys.readouterr().out
    with (out / "tracking.csv").open() as file:
        head, *rows = csv.reader(file)
    assert head[: len(ASKED)] == ASKED
    assert len(rows) == len(few)
    text = (out / "tracking.md").read_text()
    assert "$" not in text
    for picture in sorted(out.glob("*.png")):
        assert f"]({picture.name})" in text
