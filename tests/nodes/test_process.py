"""A node's process: its imports, its scheduling, and Ctrl-C while it starts."""

import os
import signal
import subprocess
import sys
import textwrap
from xml.etree import ElementTree

import pytest

from us_sim.nodes import announce_often, process
from us_sim.nodes.probe_tracker import ProbeTracker
from us_sim.nodes.process import raise_priority
from us_sim.share import find_bag


def test_ctrl_c_among_imports_is_silent():
    played = ["--ros-args", "-p", f"path:={find_bag('press_and_slide.mcap')}"]  # if it gets so far
    command = [sys.executable, "-X", "importtime", "-m", "us_sim.nodes.path_player", *played]
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in a shell's background
    node = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=dict(os.environ))
    said = []
    for line in node.stderr:
        said.append(line)
        if line.rpartition("|")[2].strip() == "us_sim.nodes":
            node.send_signal(signal.SIGINT)
            break
    said += node.communicate(timeout=60)[1].splitlines()
    assert node.returncode == 130
    assert [line for line in said if not line.startswith("import time:")] == []


WITH_A_THREAD = """
import os, threading
from us_sim.nodes.process import raise_priority
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
said = raise_priority()
asked.set()
early.join()
late = threading.Thread(target=lambda: policies.append(policy()))
late.start()
late.join()
expected = [os.SCHED_RR, os.SCHED_OTHER] if said == "realtime" else [0, 0]
raise_priority(2)
print(said, policies == expected, os.sched_getparam(0).sched_priority)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such threads")
def test_threads_that_are_there_go_first_and_none_that_come_later():
    code = textwrap.dedent(WITH_A_THREAD)
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout.split() in (
        ["realtime", "True", "2"],
        ["realtime", "True", "1"],  # where only that is allowed
        ["ordinary", "True", "0"],
    )


def test_who_may_not_goes_on_as_before(monkeypatch):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse, raising=False)
    assert raise_priority() == "ordinary"
    monkeypatch.delattr(os, "sched_setscheduler")
    assert raise_priority() == "ordinary"


@pytest.mark.parametrize(
    ("parameters", "asked"),
    [({}, True), ({"realtime": False}, False), ({"lockstep": True}, False)],
)
def test_a_node_asks_for_it_and_says_what_it_got(
    bench, small_scene, monkeypatch, parameters, asked
):
    node = bench.make(ProbeTracker, scene=str(small_scene), **parameters)
    times = []
    monkeypatch.setattr(
        process, "raise_priority", lambda priority: times.append(priority) or "realtime"
    )
    monkeypatch.setattr(process, "spin", lambda _: None)
    monkeypatch.setattr(process.rclpy, "init", lambda **_: None)
    monkeypatch.setattr(process.rclpy, "try_shutdown", lambda: None)
    monkeypatch.setattr(node, "destroy_node", lambda: None)
    monkeypatch.setattr(process.signal, "signal", lambda *_: None)
    monkeypatch.setattr(process.gc, "freeze", lambda: None)
    assert process.run_node(lambda: node) == 0
    assert (times, node.health.scheduling) == (([2], "realtime") if asked else ([], ""))


UNUSED = [
    ("us_sim.viewer.viewer, us_sim.viewer.page", {"numba", "scipy"}),
    ("us_sim.nodes.probe_tracker", {"numba", "scipy", "cv2"}),
    ("us_sim.nodes.session_player, us_sim.nodes.session_control", {"numba", "scipy", "cv2"}),
    ("us_sim.nodes.tissue_deformer", {"scipy.ndimage", "scipy.spatial", "cv2"}),
    (
        "us_sim.nodes.slice_interpolator, us_sim.slicing.acoustics.beam_acoustics, "
        "us_sim.nodes.streams.doppler, us_sim.slicing.flow.doppler",
        {"scipy.ndimage", "scipy.spatial"},
    ),
]


@pytest.mark.slow
@pytest.mark.parametrize(("modules", "unused"), UNUSED)
def test_what_a_node_does_not_use_it_does_not_import(modules, unused):
    program = f"import sys, {modules}\nprint(*({unused!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stdout.split()) == (0, []), done.stderr


def test_nodes_are_announced_often_unless_a_profile_is_set(monkeypatch):
    variable = "FASTRTPS_DEFAULT_PROFILES_FILE"
    monkeypatch.setenv(variable, "mine.xml")
    announce_often()
    assert os.environ[variable] == "mine.xml"
    monkeypatch.delenv(variable)
    announce_often()
    period = ElementTree.parse(os.environ[variable]).find(".//{*}leaseAnnouncement")
    assert [int(part.text) for part in period] == [0, 500_000_000]
