"""`evaluate tracking` in small: cases, errors, flips and filters whose answers are known."""

import csv

import numpy as np
import pytest

from us_sim.command.main import main
from us_sim.evaluation.tracking import report as tracking
from us_sim.evaluation.tracking.cases import CONDITIONS, RIGID_BODY, SINGLE, Case
from us_sim.evaluation.tracking.filters import FILTER_METHODS, delay, filter_point, filter_trials
from us_sim.evaluation.tracking.measure import Bench
from us_sim.settings.registry import FILTERS

ASKED = [
    *("marker", "image_size", "distance_m", "angle_deg", "condition", "views", "detected"),
    *("flipped", "median_mm", "p95_mm", "median_deg", "p95_deg", "ms_median"),
]


@pytest.fixture(scope="module")
def bench():
    return Bench()


def test_the_rigid_body_is_tracked_as_well_as_asked(bench):
    point = bench.point(Case(RIGID_BODY, "640x480", 0.4, 0.0), 4)
    assert len(point.found) == len(point.views) == 20
    assert point.flipped == 0
    assert point.error(50) < 0.3
    assert point.error(95) < 1.0
    assert point.turned(50) < 0.2
    assert point.turned(95) < 0.6
    assert {view.used for view in point.views} == {4}


def test_a_hand_over_a_single_marker_makes_it_be_missed_and_nothing_worse(bench):
    point = bench.point(Case(SINGLE, "640x480", 0.4, 30.0, "occlusion"), 2)
    assert len(point.views) == 10
    assert len(point.found) < 10
    assert point.flipped == 0
    assert np.isnan(point.values["pose_cpu_ms"]) == (not point.found)


@pytest.mark.parametrize("lag", [-0.01, 0.0, 0.0137, 0.21])
def test_the_delay_of_a_delayed_path_is_found(lag):
    def path(times):
        return np.stack([np.sin(3 * times), 0.2 * np.cos(11 * times)], axis=1)

    times = np.arange(0, 6, 1 / 60)
    assert delay(times, path(times - lag), path) == pytest.approx(lag, abs=1e-5)


@pytest.mark.slow
def test_filters_trade_lag_for_jitter():
    assert {method for method, *_ in filter_trials(quick=False)} == set(FILTER_METHODS)
    assert set(FILTER_METHODS) == set(FILTERS)
    points = [filter_point(*trial) for trial in filter_trials(quick=True)]
    none = next(p for p in points if p.method == "none")
    assert none.lag == pytest.approx(0.0, abs=5e-4)
    assert none.jitter == pytest.approx(np.sqrt(3) * 3e-4, rel=0.05)  # the noise itself
    euro = [p for p in points if p.method == "one_euro"]
    assert [p.lag for p in euro] == sorted((p.lag for p in euro), reverse=True)
    assert [p.jitter for p in euro] == sorted(p.jitter for p in euro)
    for p in euro:
        assert p.stated == pytest.approx(p.lag, rel=0.35)
    best = next(p for p in points if p.method == "kalman" and p.default)
    assert abs(best.lag) < 2e-3
    assert best.error < none.error
    assert best.jitter < none.jitter


@pytest.mark.slow
def test_the_report_and_its_rows_are_written(tmp_path, monkeypatch, capsys):
    few = [Case(name, "640x480", 0.4, 30.0) for name in (SINGLE, RIGID_BODY)]
    few += [Case(RIGID_BODY, "1920x1080", 0.4, 30.0)]
    few += [Case(SINGLE, "640x480", 0.4, 30.0, name) for name in CONDITIONS if name != "plain"]
    monkeypatch.setattr(tracking, "cases", lambda _: few)
    monkeypatch.setattr(tracking, "_QUICK_SEQUENCES", {"640x480": 1, "1920x1080": 1})
    small = [("APRILTAG_36h11", 24.0, 5), ("4X4_50", 32.0, 5)]
    monkeypatch.setattr(tracking, "small_marker_trials", lambda _: small)
    out = tmp_path / "report"
    assert main(["evaluate", "tracking", "--quick", "--out", str(out)]) == 0
    assert "single 40 mm marker" in capsys.readouterr().out
    with (out / "tracking.csv").open() as file:
        head, *rows = csv.reader(file)
    assert head[: len(ASKED)] == ASKED
    assert len(rows) == len(few)
    text = (out / "tracking.md").read_text()
    for picture in sorted(out.glob("*.png")):
        assert f"]({picture.name})" in text
    assert len(list(out.glob("*.png"))) == 5
    assert len((out / "filters.csv").read_text().splitlines()) == 8
    with (out / "small_markers.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["dictionary"], row["edge_px"], row["views"]) for row in rows] == [
        (name, f"{edge:g}", str(views)) for name, edge, views in small
    ]
    assert all(0 < int(row["kept"]) == int(row["found_by_opencv"]) for row in rows)
    assert "kept of" in text
    assert main(["evaluate", "tracking", "--quick", "--out", str(out)]) == 1
    assert "exists already" in capsys.readouterr().err
