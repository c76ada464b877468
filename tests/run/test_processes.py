"""Node processes: parameters, signals and threads; one simulation on a ROS domain."""

import os
import signal
import subprocess
import sys
import threading

import pytest

from us_sim.errors import UsSimError
from us_sim.run import monitored as domain_lock
from us_sim.run.monitored import alone_on_domain
from us_sim.run.plan import NodeProcess
from us_sim.run.processes import ProcessGroup


@pytest.mark.parametrize("value", ["\udcff.mcap", ["a", "\udcff"]])
def test_a_name_that_is_no_text_is_refused(value):
    with pytest.raises(UsSimError, match=r"file: .*udcff.* is no text in UTF-8"):
        NodeProcess("session_recorder", {"file": value})


def test_ctrl_c_while_a_process_is_started_is_heard():
    """Python itself forgets what is raised in what `logging` does around a fork."""
    forking = []

    def interrupt():
        if forking and forking.pop() == os.getpid():
            os.kill(os.getpid(), signal.SIGINT)

    os.register_at_fork(after_in_parent=interrupt)
    group = ProcessGroup()
    forking.append(os.getpid())
    try:
        with pytest.raises(KeyboardInterrupt):
            group.start([NodeProcess("probe_tracker")])
        assert group.is_running("probe_tracker")  # and so it can be ended
    finally:
        group.stop()


def test_without_threads_no_process_is_left(monkeypatch):
    def refuse(_):
        raise RuntimeError("can't start new thread")

    group = ProcessGroup()
    monkeypatch.setattr(threading.Thread, "start", refuse)
    with pytest.raises(UsSimError, match="probe_tracker cannot be followed: can't"):
        group.start([NodeProcess("probe_tracker")])
    monkeypatch.undo()
    assert group.stop() == []


BEGIN = """
import sys
from us_sim.errors import UsSimError
from us_sim.run.monitored import alone_on_domain
print("here", flush=True)
sys.stdin.readline()
try:
    with alone_on_domain():
        print("runs", flush=True)
        sys.stdin.readline()
except UsSimError as error:
    print(error, flush=True)
"""


@pytest.fixture(autouse=True)
def _own_domain(monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", f"test-{os.getpid()}")


@pytest.fixture(params=["name", "file"])
def _kind(request, monkeypatch):
    if request.param == "file":
        monkeypatch.setattr(domain_lock.sys, "platform", "darwin")
    elif sys.platform != "linux":
        pytest.skip("there are no abstract sockets")


@pytest.mark.usefixtures("_kind")
def test_the_second_is_refused_until_the_first_has_ended():
    with alone_on_domain():
        with pytest.raises(UsSimError, match=r"runs already on ROS domain test-.*set ROS_DOM"):
            alone_on_domain().__enter__()
        with alone_on_domain("/left"):  # another namespace
            pass
    with alone_on_domain():
        pass


def test_of_six_processes_at_once_one_goes_on_and_the_others_name_it():
    command = [sys.executable, "-c", BEGIN]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    processes = [subprocess.Popen(command, **pipes) for _ in range(6)]
    try:
        assert all(process.stdout.readline() == "here\n" for process in processes)
        for process in processes:
            process.stdin.write("\n")
            process.stdin.flush()
        said = [process.stdout.readline() for process in processes]
        (winner,) = [p for p, line in zip(processes, said, strict=True) if line == "runs\n"]
        others = [line for line in said if line != "runs\n"]
        assert all("runs already on ROS domain" in line for line in others)
        if sys.platform == "linux":
            assert any(f"(process {winner.pid})" in line for line in others)
        winner.kill()  # the lock goes with its process, however that ends
        winner.wait()
        with alone_on_domain():
            pass
    finally:
        for process in processes:
            process.kill()
            process.communicate()
