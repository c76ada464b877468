"""Latency and usage of arrivals and processes that are known beforehand, and of a real graph."""

import pytest

from us_sim.evaluation.latency.measure import LatencyCase, make_row, run_case

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
    row = make_row(heard(without=(3, 40, 100)), 97, {})
    # Of the last pose the image may yet come.
    assert (row["poses"], row["images"], row["dropped"]) == (101, 98, 2)
    assert row["not_recorded"] == 1
    assert row["ultrasound_image_ms_p50"] == pytest.approx(9.0)
    assert row["image_mm_p99"] == pytest.approx(0.9)  # 9 ms at 100 mm/s
    assert row["images_a_second"] == pytest.approx(1e9 / PERIOD, rel=0.03)


def test_a_running_graph_is_heard_and_recorded():
    (row,) = run_case(LatencyCase(seconds=1.0, realtime=False))
    assert row["poses"] > 20
    assert row["images"] > 5  # of a busy machine
    assert row["not_recorded"] == 0
    assert row["scheduling"] == "ordinary"
    hops = ("probe_pose", "tissue_nodes", "ultrasound_image")
    ages = [row[f"{hop}_ms_p50"] for hop in hops]
    assert ages == sorted(ages)
    assert 0.0 < ages[0] < ages[-1] < 2000.0
    assert {"cores_tissue_deformer", "cores_slice_interpolator"} <= set(row)
