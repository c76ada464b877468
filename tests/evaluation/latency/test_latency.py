"""Latency and usage of arrivals and processes that are known beforehand, and of a real graph."""

import subprocess
import sys

import pytest

from us_sim.evaluation.latency.measure import (
    LIVE,
    Case,
    Point,
    run_case,
)
from us_sim.evaluation.processes import usage_of

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


FAMILY = """
import os, sys
kept = bytearray(os.urandom(1)) * 80_000_000
family = [os.getpid()]
for _ in range(3):
    child = os.fork()
    if not child:
        break
    family.append(child)
else:
    print(*family, flush=True)
sys.stdin.read()
os._exit(0)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="needs Linux's /proc")
def test_memory_that_a_family_of_processes_shares_is_counted_once():
    process = subprocess.Popen(
        [sys.executable, "-c", FAMILY], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    pids = [int(word) for word in process.stdout.readline().split()]
    uses = [usage_of(pid) for pid in pids]
    process.communicate("")
    assert len(uses) == 4
    assert 80e6 < sum(use.memory for use in uses) < 160e6


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
