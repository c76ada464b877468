"""Nodes that are forked are what they would be as programs; where that cannot be they are those."""

import os
import signal
import sys
import time
from pathlib import Path

import pytest
from awaiting import until

from us_sim.run.fork_server import ForkServer
from us_sim.run.plan import NodeProcess
from us_sim.run.processes import ProcessGroup

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="forks on Linux only")

MARK = "IN_THE_ENVIRONMENT_OF_THE_FORK_SERVER"


def server():
    """A fork server whose nodes can be told from programs by what its environment was."""
    os.environ[MARK] = "1"
    try:
        return ForkServer()
    finally:
        del os.environ[MARK]


@pytest.fixture(scope="module")
def forks():
    with server() as made:  # one for all tests, since it imports for a second
        yield made


@pytest.fixture
def group(forks, tmp_path):
    running = ProcessGroup(tmp_path / "nodes.log", forks)
    yield running
    running.stop()


def recorder(folder):
    return NodeProcess("session_recorder", {"file": str(folder / "session.mcap")})


def started(group, node):
    """The node's process, once it has said so."""
    group.start([node])
    said = "recording to"
    until(lambda: group.last_words(node.node).startswith(said), "the recorder does not record")
    return group.pids[node.node]


def is_forked(pid):
    return MARK.encode() in Path(f"/proc/{pid}/environ").read_bytes()


def test_it_is_a_child_in_its_own_session_that_shows_its_command_line(group, tmp_path):
    node = recorder(tmp_path)
    pid = started(group, node)
    assert is_forked(pid)
    assert os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None  # a child
    assert os.getsid(pid) == pid
    words = Path(f"/proc/{pid}/cmdline").read_text().rstrip("\0").split("\0")
    assert words == node.command()


def test_it_ends_when_it_is_told_to(group, tmp_path):
    pid = started(group, recorder(tmp_path))
    assert group.stop() == []  # which names those that had to be killed
    assert not Path(f"/proc/{pid}").exists()


def test_how_it_ends_is_told_and_another_takes_its_place(group, tmp_path):
    node = recorder(tmp_path)
    pid = started(group, node)
    os.kill(pid, signal.SIGKILL)
    ended = until(group.take_ended, "nothing has ended")
    assert ended == {"session_recorder": -signal.SIGKILL}
    group.start([node])  # which refuses to overwrite
    assert until(group.take_ended, "it does not end") == {"session_recorder": 1}
    assert "session.mcap exists already" in str(group.failure("session_recorder", 1))


def test_one_stands_by_until_it_is_needed(group, tmp_path):
    node = recorder(tmp_path)
    until(lambda: group.stand_by(node), "it does not stand by")
    assert not (tmp_path / "nodes.log").read_text()
    (tmp_path / "session.mcap").unlink(missing_ok=True)  # it has rehearsed
    assert is_forked(started(group, node))


def test_where_the_server_has_ended_nodes_are_programs(tmp_path):
    with server() as forks:
        group = ProcessGroup(tmp_path / "nodes.log", forks)
        os.kill(forks.pid, signal.SIGKILL)
        try:
            assert not is_forked(started(group, recorder(tmp_path)))
        finally:
            group.stop()


def test_where_the_server_is_stopped_nodes_are_programs_at_once(tmp_path):
    with server() as forks:
        group = ProcessGroup(tmp_path / "nodes.log", forks)
        os.kill(forks.pid, signal.SIGSTOP)
        began = time.monotonic()
        try:
            group.start([recorder(tmp_path)])
            assert time.monotonic() - began < 20.0  # it was a minute
            assert not is_forked(group.pids["session_recorder"])
        finally:
            group.stop()


def test_what_has_threads_is_not_forked(tmp_path, monkeypatch):
    (tmp_path / "sitecustomize.py").write_text(
        "import os, threading\n"
        f"if {MARK!r} in os.environ:\n"
        "    threading.Thread(target=threading.Event().wait, daemon=True).start()\n"
    )
    search = [str(tmp_path), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(search))
    with server() as forks:
        group = ProcessGroup(tmp_path / "nodes.log", forks)
        try:
            assert not is_forked(started(group, recorder(tmp_path)))
        finally:
            group.stop()


def test_closed_it_leaves_no_process():
    forks = server()
    pid = forks.pid
    forks.close()
    assert not Path(f"/proc/{pid}").exists()
    assert forks.fork("session_recorder", [], {}, is_fed=False) is None
