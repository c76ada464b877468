"""`evaluate tracking` in small: cases, errors, flips and filters whose answers are known."""

import csv

import numpy as np
import pytest

from us_sim.command.main import main
from us_sim.evaluation.tracking import report as tracking
from us_sim.evaluation.tracking.cases import CONDITIONS, RIGID_BODY, SINGLE, Case
from us_sim.evaluation.tracking.filters import delay, filter_pieces
from us_sim.evaluation.tracking.measure import Tracking
from us_sim.settings.registry import FILTERS

ASKED = [
    *("marker", "image_size", "distance_m", "angle_deg", "condition", "views", "detected"),
    *("flipped", "median_mm", "p95_mm", "median_deg", "p95_deg", "ms_median"),
]


@pytest.mark.slow
def test_the_rigid_body_is_tracked_as_well_as_asked():
    (row,) = Tracking().row(Case(RIGID_BODY, "640x480", 0.4, 0.0), 4)
    assert row["detected"] == row["views"] == 20
    assert row["flipped"] == 0
    assert row["median_mm"] < 0.3
    assert row["p95_mm"] < 1.0
    assert row["median_deg"] < 0.2
    assert row["p95_deg"] < 0.6
    assert row["markers_used"] == 4


def test_a_hand_over_a_single_marker_makes_it_be_missed_and_nothing_worse():
    (row,) = Tracking().row(Case(SINGLE, "640x480", 0.4, 30.0, "occlusion"), 2)
    assert row["views"] == 10
    assert row["detected"] < 10
    assert row["flipped"] == 0


@pytest.mark.parametrize("lag", [-0.01, 0.0, 0.0137, 0.21])
def test_the_delay_of_a_delayed_path_is_found(lag):
    def path(times):
        return np.stack([np.sin(3 * times), 0.2 * np.cos(11 * times)], axis=1)

    times = np.arange(0, 6, 1 / 60)
    assert delay(times, path(times - lag), path) == pytest.approx(lag, abs=1e-5)


@pytest.mark.slow
def test_filters_trade_lag_for_jitter():
    rows = [{**piece.case, **row} for piece in filter_pieces(True) for row in piece.measure()]
    assert {row["filter"] for row in rows} == set(FILTERS)
    none = next(row for row in rows if row["filter"] == "none")
    assert none["lag_ms"] == pytest.approx(0.0, abs=0.5)
    assert none["jitter_mm"] == pytest.approx(np.sqrt(3) * 0.3, rel=0.05)  # the noise itself
    euro = [row for row in rows if row["filter"] == "one_euro"]
    lags, jitters = ([row[name] for row in euro] for name in ("lag_ms", "jitter_mm"))
    assert lags == sorted(lags, reverse=True)
    assert jitters == sorted(jitters)
    for row in euro:
        assert row["stated_lag_ms"] == pytest.approx(row["lag_ms"], rel=0.35)
    best = next(row for row in rows if row["filter"] == "kalman" and row["default"])
    assert abs(best["lag_ms"]) < 2.0
    assert best["error_mm"] < none["error_mm"]
    assert best["jitter_mm"] < none["jitter_mm"]


@pytest.mark.slow
def test_the_report_and_its_rows_are_written(tmp_path, monkeypatch, capsys):
    few = [Case(name, "640x480", 0.4, 30.0) for name in (SINGLE, RIGID_BODY)]
    few += [Case(RIGID_BODY, "1920x1080", 0.4, 30.0)]
    few += [Case(SINGLE, "640x480", 0.4, 30.0, name) for name in CONDITIONS if name != "plain"]
    monkeypatch.setattr(tracking, "cases", lambda _: few)
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
    assert len((out / "filters.csv").read_text().splitlines()) == 8
