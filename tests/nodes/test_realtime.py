"""Nodes go before ordinary programs where they may, and what they start does not."""

import os
import subprocess
import sys
import textwrap

import pytest

from us_sim.nodes import process
from us_sim.nodes.probe_tracker import ProbeTracker
from us_sim.nodes.process import go_first, scheduling_of

WITH_A_THREAD = """
import os, threading
from us_sim.nodes.process import go_along, go_first, scheduling_of
def policy():
    return os.sched_getscheduler(threading.get_native_id()) & ~os.SCHED_RESET_ON_FORK
there, asked, policies = threading.Event(), threading.Event(), []
def wait():
    there.set()
    asked.wait()
    policies.append(policy())
early = threading.Thread(target=wait)
early.start()
there.wait()
said = go_first()
asked.set()
early.join()
late = threading.Thread(target=lambda: policies.append(policy()))
late.start()
late.join()
here = scheduling_of(os.getpid())
go_along()
after = scheduling_of(os.getpid())
expected = [os.SCHED_RR, os.SCHED_OTHER] if said == "realtime" else [0, 0]
print(said, here, after, policies == expected)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such threads")
def test_threads_that_are_there_go_first_and_none_that_come_later():
    code = textwrap.dedent(WITH_A_THREAD)
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout.split() in (
        ["realtime", "realtime", "ordinary", "True"],
        ["ordinary", "ordinary", "ordinary", "True"],
    )


def test_who_may_not_goes_on_as_before(monkeypatch):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse, raising=False)
    assert go_first() == "ordinary"
    monkeypatch.delattr(os, "sched_setscheduler")
    assert go_first() == "ordinary"
    assert scheduling_of(2**22 + 1) == "ordinary"  # there is no such process
    monkeypatch.delattr(os, "sched_getscheduler", raising=False)
    assert scheduling_of(os.getpid()) == "ordinary"


@pytest.mark.parametrize(
    ("parameters", "asked"),
    [({}, True), ({"realtime": False}, False), ({"lockstep": True}, False)],
)
def test_a_node_asks_for_it_and_says_what_it_got(
    bench, small_scene, monkeypatch, parameters, asked
):
    node = bench.make(ProbeTracker, scene=str(small_scene), **parameters)
    times = []
    monkeypatch.setattr(process, "go_first", lambda: times.append(1) or "realtime")
    monkeypatch.setattr(process, "spin", lambda _: None)
    monkeypatch.setattr(process.rclpy, "init", lambda **_: None)
    monkeypatch.setattr(process.rclpy, "try_shutdown", lambda: None)
    monkeypatch.setattr(node, "destroy_node", lambda: None)
    monkeypatch.setattr(process.signal, "signal", lambda *_: None)
    monkeypatch.setattr(process.gc, "freeze", lambda: None)
    assert process.run_node(lambda: node) == 0
    assert (len(times), node.health.scheduling) == ((1, "realtime") if asked else (0, ""))
