"""Latency and usage of arrivals and processes that are known beforehand, and of a real graph."""

import csv
import os
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from awaiting import until

from us_sim.errors import UsSimError
from us_sim.evaluation.latency import report as latency
from us_sim.evaluation.latency.measure import (
    COARSE,
    DEMO,
    FINE,
    LIVE,
    PLACED,
    Case,
    Point,
    cases,
    run_case,
    write_scene,
)
from us_sim.evaluation.latency.report import evaluate_latency, targets
from us_sim.evaluation.processes import Usage, UsageOverTime, started_by, usage_of
from us_sim.run.plan import module_of
from us_sim.scene.building import tissue_model_of, volume_of
from us_sim.scene.reading import load_scene

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


def growing(megabytes_a_minute, seconds=300.0):
    usage = UsageOverTime()
    for now in np.arange(0.0, seconds):
        early = 50.0 * min(now, 30.0)  # MB, while it starts
        memory = 1e6 * (100.0 + early + megabytes_a_minute * now / 60.0)
        usage.add(now, Usage(processor=0.25 * now, memory=memory))
    return usage


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


def test_memory_that_grows_is_told_from_memory_that_is_taken_at_first():
    assert growing(0.0).growth == pytest.approx(0.0, abs=1e3)
    assert growing(3.0).growth == pytest.approx(3e6, rel=1e-3)
    assert np.isnan(growing(3.0, seconds=60.0).growth)
    assert growing(0.0).processor == pytest.approx(0.25)


def test_a_process_s_own_time_is_counted():
    usage = UsageOverTime()
    usage.add(0.0, usage_of(os.getpid()))
    if not usage.times:
        pytest.skip("this system has no /proc")
    start = time.process_time()
    while (used := time.process_time() - start) < 0.3:
        pass
    usage.add(1.0, usage_of(os.getpid()))
    assert usage.processor == pytest.approx(used, abs=0.1)
    assert usage_of(2**22 + 1) is None


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


@pytest.mark.skipif(sys.platform != "linux", reason="needs Linux's /proc")
@pytest.mark.parametrize("node", ["tissue_deformer", "viewer"])
def test_a_process_has_the_name_of_its_node(node):
    waits = [sys.executable, "-c", "input()", "-m", module_of(node)]
    with subprocess.Popen(waits, stdin=subprocess.PIPE) as process:
        until(lambda: started_by(os.getpid())[process.pid] == node, f"the name {node}")
        process.communicate(b"\n")


def test_limits_are_judged_by_the_case_they_are_for():
    good = Point(LIVE, heard(), recorded=101, usage={"tissue_deformer": growing(0.5)})
    slow = Point(replace(DEMO, busy=True), heard(image=60.0), recorded=101)
    met = [target.met for target in targets([good, slow])]
    assert met == [True, True, True, True, True, True, False]
    assert [t.met for t in targets([])] == [None] * 7
    unlike = Point(replace(LIVE, viewer=True), heard(image=90.0))
    assert targets([unlike, good])[2].met
    held_up = Point(replace(DEMO, busy=True, realtime=False), heard(image=90.0))
    assert targets([held_up])[-1].met is None


@pytest.mark.parametrize("case", [Case(), Case("msds", FINE, (256, 300))], ids=str)
def test_a_case_s_scene_is_the_arm_with_what_it_changes(case, tmp_path):
    scene = load_scene(str(write_scene(case, tmp_path)))
    assert scene.tissue.solver == case.solver
    assert scene.probe.image == case.image
    if case.mesh != COARSE:
        assert len(tissue_model_of(scene, volume_of(scene)).mesh.nodes) == 8192


def test_every_way_is_in_a_full_run():
    planned = cases(quick=False)
    assert {case.placed for case in planned} == set(PLACED)
    assert {case.recorder for case in planned} == {case.viewer for case in planned} == {True, False}
    assert len(set(planned)) == len(planned)
    assert {LIVE, DEMO, replace(DEMO, busy=True)} <= set(planned)


def test_a_report_has_every_case_and_says_what_failed(tmp_path, monkeypatch, capsys):
    def run(case, tell):
        tell(case.seconds, "running")
        if case.busy:
            raise UsSimError("the tissue has ended")
        if case.placed == "lockstep":
            return Point(case, throughput=123.0)
        return Point(case, heard(), recorded=101, usage={"tissue_deformer": growing(0.5)})

    monkeypatch.setattr(latency, "run_case", run)
    monkeypatch.setattr("us_sim.evaluation.latency.measure.prepare_volume", lambda _: None)
    assert evaluate_latency(tmp_path, quick=False) == 1
    report = (tmp_path / "latency.md").read_text()
    assert "cores busy: UsSimError: the tissue has ended" in report
    assert "| 123 " in report
    for name in ("hops", "usage", "time"):
        assert (tmp_path / f"latency_{name}.png").stat().st_size > 10_000
    with (tmp_path / "latency.csv").open() as file:
        head, *rows = csv.reader(file)
    assert len(rows) == len(cases(quick=False))
    # Also of a case of which nothing was heard, each number is below its name.
    assert {len(row) for row in rows} == {len(head)}
    assert {row[head.index("images_a_second")] for row in rows} == {"62.5", "123", ""}
    assert "failed: " in capsys.readouterr().out


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
