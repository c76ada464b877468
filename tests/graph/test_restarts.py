"""Nodes ended from outside come back, nobody else is started again, and what was lost is said."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from many_restarts import forks_of, nodes_of

from us_sim.errors import BagError
from us_sim.recording.reader import read_bag
from us_sim.run.plan import NodeProcess
from us_sim.run.processes import RunningNode, end_nodes

IMAGES = "/ultrasound/image"
ENDED = {
    "slice_interpolator": (signal.SIGKILL, "was ended by SIGKILL"),
    "tissue_deformer": (signal.SIGTERM, "ended with status 0"),
    "session_recorder": (signal.SIGSTOP, "has not reported for 10 s"),
}

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs Linux's /proc")


def started(*words, cwd):
    """`us-sim WORDS` in a process of its own."""
    command = [sys.executable, "-m", "us_sim", *map(str, words)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=cwd)


def wait_until(condition, process):
    """Wait while the process runs."""
    deadline = time.monotonic() + 100
    while not condition():
        assert process.poll() is None, process.stderr.read()
        assert time.monotonic() < deadline
        time.sleep(0.05)  # what runs needs this core


def images_in(recording):
    """Their number so far."""
    try:
        topics = read_bag(recording).topics
    except BagError:
        return 0
    return sum(topic.message_count for topic in topics if topic.name == IMAGES)


def test_nodes_that_end_are_back_and_the_rest_goes_on(played_scene, tmp_path):
    out = tmp_path / "out"
    options = [
        "--out",
        out,
        "--restarts",
        "1",
        "--silence",
        "10",
        "--param",
        "path_player.loop=true",
    ]
    demo = started("demo", played_scene, *options, cwd=tmp_path)
    try:
        # By then each node has reported, once a second, to who watches it.
        wait_until(lambda: images_in(out / "session.mcap") > 150, demo)
        before = nodes_of(demo.pid)
        for node, (number, _) in ENDED.items():
            os.kill(before[node], number)
        further = out / "session_1.mcap"
        wait_until(lambda: images_in(further) > 20, demo)
        after = nodes_of(demo.pid)
        assert before.keys() == after.keys()
        assert {node for node in after if after[node] != before[node]} == set(ENDED)
        gone = after["path_player"]
        os.kill(gone, signal.SIGKILL)
        wait_until(lambda: nodes_of(demo.pid).get("path_player", gone) != gone, demo)
        # The second time it is given up, so no pose is to come any more, and the demo ends.
        os.kill(nodes_of(demo.pid)["path_player"], signal.SIGKILL)
        said = demo.communicate(timeout=60)[1]
    finally:
        demo.kill()
    assert demo.returncode == 1
    assert "Traceback" not in said
    told = said.splitlines()[-1]
    summary = json.loads((out / "summary.json").read_text())
    for node, (_, what) in ENDED.items():
        assert f"{node} {what} after " in said
        (lost,) = (each for each in summary["lost"] if each.startswith(f"{node} {what} at "))
        assert "was back after" in lost
        assert lost in told or "more times" in told
    assert "path_player" in summary["lost"][-1]
    assert summary["lost"][-1].endswith("is not started again after 1 restart")
    assert summary["images_out"] == images_in(out / "session.mcap") + images_in(further)
    assert "session.mcap, session_1.mcap" in told
    # The recording says it by itself, too.
    assert "slice_interpolator was ended by SIGKILL" in str(summary["nodes"]["session_monitor"])


def test_of_two_simulations_at_once_one_is_refused(played_scene, tmp_path):
    runs = [started("run", played_scene, cwd=tmp_path) for _ in range(2)]
    try:
        deadline = time.monotonic() + 60
        while all(run.poll() is None for run in runs):
            assert time.monotonic() < deadline
            time.sleep(0.05)
        loser, winner = sorted(runs, key=lambda run: run.poll() is None)
        assert loser.returncode == 1
        said = loser.stderr.read()
        assert "another simulation runs already on ROS domain" in said
        assert said.count("\n") == 1
        wait_until(lambda: len(nodes_of(winner.pid)) == 4, winner)
        winner.send_signal(signal.SIGINT)
        winner.communicate(timeout=30)
        assert winner.returncode == 130
    finally:
        for run in runs:
            run.kill()


def test_where_nodes_are_forked_ends_they_end_and_are_back(played_scene, tmp_path):
    run = started("run", played_scene, "--duration", "100", cwd=tmp_path)
    try:
        wait_until(lambda: len(nodes_of(run.pid)) == 4, run)
        before, server = nodes_of(run.pid), forks_of(run.pid)
        os.kill(server, signal.SIGKILL)
        wait_until(lambda: len({*nodes_of(run.pid).values()} - {*before.values()}) == 4, run)
        wait_until(lambda: not any(Path(f"/proc/{p}").exists() for p in before.values()), run)
        run.send_signal(signal.SIGINT)
        said = run.communicate(timeout=60)[1]
    finally:
        run.kill()
    for node in before:
        assert f"{node} was told to end by a signal" in said


def main(_):
    """A node that does not end when it is told to."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    print("deaf", flush=True)
    time.sleep(100)


@pytest.fixture
def deaf(monkeypatch):
    """A node that does not end when it is told to."""
    monkeypatch.syspath_prepend(Path(__file__).parent)
    monkeypatch.setattr(NodeProcess, "module", Path(__file__).stem)
    node = RunningNode(NodeProcess("session_recorder"), lambda *_: None)
    deadline = time.monotonic() + 30
    while node.last_words != "deaf":
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return node


def test_a_node_that_does_not_end_is_killed_and_that_is_told(deaf):
    assert end_nodes([deaf], 0.2) == ["session_recorder"]
    assert deaf.status == -signal.SIGKILL
    assert not Path(f"/proc/{deaf.pid}").exists()


def test_one_that_was_stopped_ends_by_itself_when_it_is_told_to(tmp_path):
    node = RunningNode(
        NodeProcess("session_recorder", {"file": str(tmp_path / "a.mcap")}), lambda *_: None
    )
    node.send_signal(signal.SIGSTOP)
    assert end_nodes([node], 10.0) == []
