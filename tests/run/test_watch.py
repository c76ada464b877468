"""Silence of a node told apart from a pause of the watch itself."""

import pytest

from us_sim.errors import SettingsError
from us_sim.run.plan import NodeProcess
from us_sim.run.supervision import going_on
from us_sim.run.watch import START_S, SupervisionSettings, Watch

NODE, PID = "tissue_deformer", 7


class Machine:
    """A clock and a node that the test moves."""

    def __init__(self):
        self.now, self.reports = 0.0, 1
        self.watch = Watch(10.0, clock=lambda: self.now)
        self.hung()

    def hung(self):
        return self.watch.hung({NODE: PID}, {(NODE, PID): self.reports}).get(NODE, "")

    def pass_time(self, seconds, *, step=0.1, reporting=False):
        """Look again and again until something is told; when that was, and what."""
        told, until = "", self.now + seconds
        while not told and self.now < until:
            self.now += step
            self.reports += reporting
            told = self.hung()
        return self.now, told


@pytest.fixture
def machine():
    return Machine()


def test_a_node_that_reports_never_hangs(machine):
    assert machine.pass_time(1000.0, step=0.5, reporting=True)[1] == ""


def test_a_silent_one_hangs_and_is_told_once(machine):
    when, told = machine.pass_time(100.0)
    assert when == pytest.approx(10.0, abs=0.15)
    assert told == "has not reported for 10 s"
    assert machine.pass_time(9.0)[1] == ""


def test_time_in_which_nobody_looked_is_no_silence(machine):
    assert machine.pass_time(15 * 3600.0, step=3600.0)[1] == ""  # a laptop that was closed
    assert machine.pass_time(10.0)[1]


def test_the_first_report_may_take_long_since_a_node_may_compile(machine):
    machine.reports = 0
    assert machine.pass_time(START_S - 1.0, step=0.5)[1] == ""
    assert machine.pass_time(2.0)[1]


def test_another_process_of_the_node_starts_anew(machine):
    machine.pass_time(9.0)
    assert machine.watch.hung({NODE: PID + 1}, {(NODE, PID): 1}) == {}


@pytest.mark.parametrize("wrong", [{"restarts": -1}, {"silence": "1 s"}])
def test_what_cannot_be_is_refused(wrong):
    with pytest.raises(SettingsError, match="is outside"):
        SupervisionSettings(**wrong)


def test_a_player_goes_on_where_its_path_would_be():
    player = NodeProcess("path_player", {"path": "a.mcap"})
    again = going_on(player, {"played": "120", "begun": "1700000000.250000000"})
    assert again.parameters == {"path": "a.mcap", "begun": 1700000000.25}
    assert going_on(player, {"state": "waiting"}) is player
    assert going_on(player, {"begun": "soon"}) is player


def test_a_viewer_goes_on_where_pages_look_for_it():
    viewer = NodeProcess("viewer", {"host": "127.0.0.1", "port": 0})
    assert going_on(viewer, {"port": "41234"}).parameters["port"] == 41234
    assert going_on(viewer, {"port": "any"}).parameters["port"] == 0


def test_others_start_as_they_did():
    tissue = NodeProcess("tissue_deformer", {"scene": "upper_arm", "solver": "msds"})
    assert going_on(tissue, {"state": "ready"}) is tissue
