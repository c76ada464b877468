"""One simulation on a domain of this host: of many that begin at once exactly one goes on."""

import os
import subprocess
import sys

import pytest

from us_sim.errors import UsSimError
from us_sim.run import monitored as domain_lock
from us_sim.run.monitored import alone_on_domain

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
