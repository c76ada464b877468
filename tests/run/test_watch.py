"""Supervision: silence told apart from work, waiting, sleep and a stop; how often it restarts."""

import os
import signal
import subprocess
import sys
import time

import pytest

from us_sim.errors import SettingsError
from us_sim.run.plan import NodeProcess
from us_sim.run.supervision import going_on
from us_sim.run.watch import (
    ProcessState,
    Restarts,
    SupervisionSettings,
    Watch,
    process_state,
)

NODE, PID = "tissue_deformer", 7


class Machine:
    """A clock and a process that the test moves."""

    def __init__(self):
        self.now = 0.0
        self.state = ProcessState(is_stopped=False, is_waiting=False, cpu=0.0)
        self.reports = 0
        self.watch = Watch(10.0, clock=lambda: self.now, state=lambda _: self.state)

    def hung(self):
        return self.watch.hung({NODE: PID}, {(NODE, PID): self.reports}).get(NODE, "")

    def pass_time(self, seconds, *, step=0.1, works=0.0, reporting=False, **state):
        """Until something is told, looked at again and again; when that was, and what."""
        told = ""
        for _ in range(round(seconds / step)):
            self.now += step
            cpu = self.state.cpu + works * step
            self.state = ProcessState(
                state.get("is_stopped", False), state.get("is_waiting", False), cpu
            )
            self.reports += reporting
            if told := self.hung():
                break
        return self.now, told


@pytest.fixture
def machine():
    machine = Machine()
    machine.hung()
    machine.reports = 1
    machine.hung()
    return machine


def test_a_node_that_reports_never_hangs(machine):
    assert machine.pass_time(1000.0, step=0.5, reporting=True) == (1000.0, "")


def test_one_that_does_nothing_hangs_after_the_silence(machine):
    when, told = machine.pass_time(100.0)
    assert when == pytest.approx(10.0, abs=0.15)
    assert told == "has not reported for 10 s"


@pytest.mark.parametrize("busy", [{"works": 1.0}, {"works": 0.6}, {"is_waiting": True}])
def test_one_that_works_or_waits_for_a_processor_has_six_times_as_long(machine, busy):
    when, told = machine.pass_time(100.0, **busy)
    assert when == pytest.approx(60.0, abs=0.15)
    assert told == "has not reported for 60 s"


def test_one_that_is_stopped_is_told_at_once(machine):
    when, told = machine.pass_time(100.0, is_stopped=True)
    assert when == pytest.approx(0.5, abs=0.15)
    assert told == "was stopped (SIGSTOP)"


def test_time_in_which_nobody_looked_is_no_silence(machine):
    for _ in range(15):
        machine.now += 3600.0  # a laptop that was closed
        assert machine.hung() == ""
    machine.now += 3600.0
    for _ in range(20):
        machine.now += 0.5
        told = machine.hung()
        if told:
            break
    assert told


@pytest.mark.parametrize(("works", "seconds"), [(0.0, 300), (1.0, 1800)])
def test_the_first_report_may_take_long_and_longer_while_it_compiles(works, seconds):
    fresh = Machine()
    fresh.hung()
    assert fresh.pass_time(seconds - 1.0, step=0.5, works=works)[1] == ""
    told = fresh.pass_time(2.0, step=0.5, works=works)[1]
    assert told == f"has not reported for {seconds} s"


def test_another_process_of_the_node_starts_anew(machine):
    machine.pass_time(9.0)
    assert machine.watch.hung({NODE: PID + 1}, {(NODE, PID): 1}) == {}
    assert machine.watch.hung({NODE: PID + 1}, {(NODE, PID): 2}) == {}


def test_a_process_hangs_when_a_node_in_it_is_silent(machine):
    told = {}
    for report in range(2, 40):
        machine.now += 0.5
        heard = {("composed", PID): report, (NODE, PID): 1}
        told |= machine.watch.hung({"composed": PID}, heard, {"composed": [NODE]})
    assert told == {"composed": f"was ended, since {NODE} in it has not reported for 10 s"}


@pytest.mark.skipif(sys.platform != "linux", reason="needs Linux's /proc")
def test_the_state_of_a_real_process():
    code = "while True: pass"
    with subprocess.Popen([sys.executable, "-c", code]) as process:
        try:
            deadline = time.monotonic() + 30
            while process_state(process.pid).cpu < 0.05:
                assert time.monotonic() < deadline
            assert not process_state(process.pid).is_stopped
            process.send_signal(signal.SIGSTOP)
            os.waitpid(process.pid, os.WUNTRACED)
            state = process_state(process.pid)
            assert state.is_stopped
            assert not state.is_waiting
        finally:
            process.kill()
    assert process_state(process.pid) is None


def refusals(times, **settings):
    """The sentences at these times, s."""
    now = [0.0]
    restarts = Restarts(SupervisionSettings(**settings), clock=lambda: now[0])
    told = []
    for now[0] in times:
        told.append(restarts.refused("a"))
    return told, restarts


def test_so_many_in_all():
    told, restarts = refusals([100.0 * k for k in range(4)], restarts=3)
    assert told[:3] == ["", "", ""]
    assert told[3] == "is not started again after 3 restarts"
    assert restarts.refused("b") == ""  # every node has its own


def test_so_many_in_a_minute():
    told, _ = refusals([0.0, 10.0, 20.0, 30.0, 61.0, 62.0], restarts_per_minute=3)
    assert [not refused for refused in told] == [True, True, True, False, True, False]
    assert told[3] == "is not started again after 3 restarts within a minute"


def test_none():
    told, _ = refusals([0.0], restarts=0)
    assert told == ["is not started again after 0 restarts"]


@pytest.mark.parametrize("wrong", [{"restarts": -1}, {"silence": "1 s"}])
def test_what_cannot_be_is_refused(wrong):
    with pytest.raises(SettingsError, match="is outside"):
        SupervisionSettings(**wrong)


def test_a_recorder_goes_on_in_a_further_file():
    recorder = NodeProcess("session_recorder", {"file": "a.mcap"}, {"compression": "zstd"})
    again = going_on(recorder, {})
    wanted = {"file": "a.mcap", "compression": "zstd", "if_exists": "further"}
    assert again.all_parameters == going_on(again, {}).all_parameters == wanted


def test_a_player_goes_on_where_its_path_would_be():
    player = NodeProcess("path_player", {"path": "a.mcap"})
    again = going_on(player, {"played": "120", "begun": "1700000000.250000000"})
    assert again.all_parameters == {"path": "a.mcap", "begun": 1700000000.25}
    assert going_on(player, {"state": "waiting"}) is player
    assert going_on(player, {"begun": "soon"}) is player


def test_a_viewer_goes_on_where_pages_look_for_it():
    viewer = NodeProcess("viewer", {"host": "127.0.0.1", "port": 0})
    assert going_on(viewer, {"port": "41234"}).all_parameters["port"] == 41234
    assert going_on(viewer, {"port": "any"}).all_parameters["port"] == 0


def test_others_start_as_they_did():
    tissue = NodeProcess("tissue_deformer", {"scene": "upper_arm"}, {"solver": "msds"})
    assert going_on(tissue, {"state": "ready"}) is tissue
