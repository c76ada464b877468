"""How often a node is started again, and how it goes on."""

import pytest

from us_sim.errors import SettingsError
from us_sim.run.plan import NodeProcess
from us_sim.run.supervision import going_on
from us_sim.run.watch import Restarts, SupervisionSettings


def refusals(times, **settings):
    """What is said at these times, s."""
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
