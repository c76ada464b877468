"""Node processes: parameters, signals and threads; one simulation on a ROS domain."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from us_sim.errors import UsSimError
from us_sim.run.domain import lock_domain
from us_sim.run.plan import NodeProcess
from us_sim.run.processes import RunningNode, end_nodes
from us_sim.run.shared_memory import remove_abandoned_segments


def wait_until(condition):
    deadline = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def files_of(pid):
    """Lock files of Fast DDS that a process holds."""
    links = []
    for link in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # it has just been closed
            links.append(os.readlink(link))
    return [Path(link) for link in links if link.startswith("/dev/shm/fastrtps_")]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere these files are not in /dev/shm")
def test_what_killed_nodes_leave_in_shared_memory_is_removed_and_nothing_else(monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "24")
    monkeypatch.setenv("FASTDDS_BUILTIN_TRANSPORTS", "DEFAULT")
    nodes = [RunningNode(NodeProcess("scorer"), print) for _ in range(3)]
    try:
        wait_until(lambda: all(len(files_of(each.pid)) >= 3 for each in nodes))
        killed, *living = nodes
        left, used = files_of(killed.pid), [file for each in living for file in files_of(each.pid)]
        killed.send_signal(signal.SIGKILL)
        wait_until(lambda: killed.status is not None)
        remove_abandoned_segments()
        assert not any(file.exists() for file in left)
        assert left
        assert used
        assert all(file.exists() for file in used)
    finally:
        end_nodes(nodes)


def runs(pid):
    """Whether a process is there, and is not only waited for."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere nodes are not forked")
def test_what_forks_nodes_has_one_thread_and_no_rclpy():
    program = "import us_sim.run.preloaded, os, sys; "
    program += "print(len(os.listdir('/proc/self/task')), 'rclpy' in sys.modules)"
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert ended.stdout.split() == ["1", "False"], ended.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere nodes are not forked")
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGSTOP])
def test_what_forks_nodes_is_there_again_after_a_signal(number):
    program = "import us_sim.run.preloaded, os, sys; "
    program += "print(os.getpid(), flush=True); sys.stdin.read(); exit(3)"
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", program], stdin=pipe, stdout=pipe) as keeper:
        first = int(keeper.stdout.readline())
        os.kill(first, number)
        if number != signal.SIGSTOP:
            assert int(keeper.stdout.readline()) != first
            assert not runs(first)
        keeper.stdin.close()
        assert keeper.wait(30) == 3


STARTS = """
import time
from us_sim.run.plan import NodeProcess
from us_sim.run.processes import RunningNode
if __name__ == "__main__":
    node = RunningNode(NodeProcess("scorer"), lambda *_: None, is_forked={is_forked})
    print(node.pid, flush=True)
    time.sleep(60)
"""


@pytest.mark.slow
@pytest.mark.parametrize(("is_forked", "after"), [(True, 0.0), (True, 2.0), (False, 2.0)])
def test_what_was_started_ends_with_a_killed_parent(is_forked, after, tmp_path):
    program = tmp_path / "program.py"
    program.write_text(STARTS.format(is_forked=is_forked))
    parent = subprocess.Popen([sys.executable, program], stdout=subprocess.PIPE, text=True)
    pid = int(parent.stdout.readline())
    time.sleep(after)  # while they import, or as they run
    parent.kill()
    parent.wait()
    wait_until(lambda: not runs(pid))


@pytest.fixture(autouse=True)
def _own_domain(monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", f"test-{os.getpid()}")


def test_the_second_is_refused_until_the_first_has_ended():
    with lock_domain():
        with pytest.raises(UsSimError, match=r"runs already on ROS domain test-.*set ROS_DOM"):
            lock_domain().__enter__()
        with lock_domain("/left"):  # another namespace
            pass
    with lock_domain():
        pass


def test_a_killed_one_leaves_the_domain_free():
    waits = "with lock_domain(): print(flush=True); input()"
    program = f"from us_sim.run.domain import lock_domain\n{waits}"
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", program], stdin=pipe, stdout=pipe) as first:
        first.stdout.readline()
        with pytest.raises(UsSimError, match="runs already"):
            lock_domain().__enter__()
        first.kill()
    with lock_domain():
        pass
