"""Latency and usage of arrivals and processes that are known beforehand, and of a real graph."""

import pytest

from us_sim.evaluation.latency.measure import (
    LIVE,
    Case,
    Point,
    run_case,
)

PERIOD = 16_000_000  # ns


def heard(count=101, *, nodes=5.0, image=9.0, without=()):
    """Poses, and nodes and images that are some ms old when they come; some images do not."""
    stamps = [1_000_000_000 + k * PERIOD for k in range(count)]
    return {
        "tracker/pose": [(s, s) for s in stamps],
        "tissue/nodes": [(s, s + round(1e6 * nodes)) for s in stamps],
        "ultrasound/image": [
            (s, s + round(1e6 * image)) for k, s in enumerate(stamps) if k not in without
        ],
    }


def test_ages_counts_and_ways_are_those_of_what_was_heard():
    point = Point(LIVE, heard(without=(3, 40, 100)), recorded=97)
    values = point.values
    assert (values["poses"], values["images"], values["dropped"]) == (
        101,
        98,
        2,
    )  # the last may come
    assert values["not_recorded"] == 1
    assert values["ultrasound_image_ms_p50"] == pytest.approx(9.0)
    assert values["image_mm_p99"] == pytest.approx(0.9)  # 9 ms at 100 mm/s
    assert point.rate == pytest.approx(1e9 / PERIOD, rel=0.03)


def test_a_running_graph_is_heard_and_recorded():
    told = []
    case = Case(seconds=1.0, realtime=False)
    point = run_case(case, lambda seconds, words: told.append((seconds, words)))
    assert len(point.heard["tracker/pose"]) > 20
    assert len(point.images) > 5  # of a busy machine
    assert point.lost == 0
    assert point.values["scheduling"] == "ordinary"
    ages = [
        point.latency(topic, 50) for topic in ("probe/pose", "tissue/nodes", "ultrasound/image")
    ]
    assert ages == sorted(ages)
    assert 0.0 < ages[0] < ages[-1] < 2000.0
    assert {"tissue_deformer", "slice_interpolator", "session_recorder"} <= set(point.usage)
    assert told[0] == (0.0, "starting")
