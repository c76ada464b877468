"""A running simulation follows its control, here without any process."""

import os
from dataclasses import replace
from types import SimpleNamespace

import pytest

from us_sim.errors import SettingsError, UsSimError
from us_sim.nodes.settings import SessionControlSettings
from us_sim.recording.writer import BagWriter
from us_sim.run.plan import RunRequest, make_plan
from us_sim.run.simulation import Simulation, list_bags
from us_sim.scene.reading import load_scene
from us_sim.share import shared_path

PATH = str(shared_path("bags/press_and_slide.mcap"))


class Supervisor:
    """Runs plans on paper: all nodes are ready at once, unless the test says why they fail."""

    def __init__(self, plan, control):
        self.plan, self.why, self.waiting = plan, "", []
        self.add_control = lambda _check, _take, settings: (
            control.set_state_parameters(settings) or control
        )
        self.monitor = SimpleNamespace(reports={})
        self.plans = [plan]

    def change_plan(self, plan, anew=()):
        assert set(anew) <= set(self.plan.nodes)
        self.plan = plan
        self.plans.append(plan)

    def update(self):
        why, self.why = self.why, ""
        if why:
            raise UsSimError(why)


class Control:
    """Shows what it is told."""

    is_list_wanted = True

    def __init__(self):
        self.values = SessionControlSettings()
        self.told, self.to_player = [], []

    def set_state_parameters(self, settings):
        self.values = settings

    def publish_state(self, state, values, warning=""):
        self.told.append((state, values, warning))

    def set_player_parameters(self, node, values):
        self.to_player.append((node, values))

    def publish_bags(self, bags):
        self.bags = bags

    def publish_scenes(self, scenes):
        self.scenes = scenes


@pytest.fixture
def running(small_scene):
    request = RunRequest(load_scene(small_scene), by_hand=True)
    control = Control()
    supervisor = Supervisor(make_plan(request), control)
    simulation = Simulation(request, supervisor)
    simulation.update()
    return simulation, supervisor, control


def ask(simulation, control, **values):
    control.values = replace(control.values, **values)
    simulation.check_request(control.values, set(values))
    simulation.apply_request(control.values, set(values))


def test_a_recording_and_a_replay_come_and_go_beside_the_nodes(running, tmp_path, monkeypatch):
    simulation, supervisor, control = running
    nodes = set(supervisor.plan.nodes)
    monkeypatch.chdir(tmp_path)
    ask(simulation, control, record="a.mcap")
    assert set(supervisor.plan.nodes) == nodes | {"session_recorder"}
    simulation.update()
    assert control.told[-1][1]["record"] == str(tmp_path.resolve() / "a.mcap")
    assert control.told[-1][1]["record_state"] == "starting"
    supervisor.monitor.reports["session_recorder"] = {
        "state": "recording",
        "note": "it lies beside another",
        "bytes": "1500",
    }
    simulation.update()
    told = control.told[-1][1]
    assert told["record_state"] == "recording"
    assert told["record_note"] == "it lies beside another"
    assert told["record_bytes"] == "1500"
    supervisor.waiting = ["session_recorder"]  # it was started again
    simulation.update()
    assert control.told[-1][1]["record_state"] == "starting"
    supervisor.waiting = []
    ask(simulation, control, replay=PATH, replay_rate=0.5)
    assert set(supervisor.plan.nodes) == nodes | {"session_recorder", "path_player"}
    player = supervisor.plan.processes[-1].parameters
    assert (player["rate"], player["stay"]) == (0.5, True)
    ask(simulation, control, replay_time=3.0)
    assert control.to_player[-1] == ("path_player", {"time": 3.0})
    ask(simulation, control, replay_paused=True)
    assert control.to_player[-1] == ("path_player", {"paused": True})
    simulation.update()
    assert control.told[-1][1]["replay"] == PATH
    ask(simulation, control, record=None, replay=None)
    assert set(supervisor.plan.nodes) == nodes


def test_a_whole_recording_takes_the_place_of_the_nodes_until_it_ends(running, tmp_path):
    simulation, supervisor, control = running
    before = supervisor.plan.processes
    ask(simulation, control, replay=PATH, replay_as="recording")
    assert supervisor.plan.nodes == ["session_player"]
    with pytest.raises(SettingsError, match="end the replay first"):
        ask(simulation, control, record=str(tmp_path / "a.mcap"))
    control.values = replace(control.values, record=None)
    ask(simulation, control, replay=None)
    assert supervisor.plan.processes == before


@pytest.mark.parametrize(
    ("values", "why"),
    [
        ({"record": "a.bag"}, "must be a file that ends in .mcap"),
        ({"record": "nowhere/a.mcap"}, "there is no such folder"),
        ({"record": PATH}, "exists already"),
        ({"replay": "nowhere.mcap"}, "there is no bag at nowhere.mcap"),
        ({"scene": "nowhere"}, "there is no scene file nowhere"),
    ],
)
def test_what_cannot_be_is_refused(running, values, why):
    simulation, supervisor, control = running
    with pytest.raises(UsSimError, match=why):
        ask(simulation, control, **values)
    assert len(supervisor.plans) == 1


def test_what_turns_out_not_to_work_is_taken_back(running):
    simulation, supervisor, control = running
    before = supervisor.plan
    supervisor.waiting = ["path_player"]
    ask(simulation, control, replay=PATH)
    supervisor.why = "path_player cannot work"
    simulation.update()
    assert supervisor.plan.processes == before.processes
    assert control.told[-1][2] == "path_player cannot work; small runs as before"
    assert control.values.replay is None
    supervisor.why = "tissue_deformer cannot work"
    with pytest.raises(UsSimError, match="tissue_deformer"):
        simulation.update()  # there is nothing more to go back to


def test_a_scene_that_is_loaded_says_that_there_are_no_images_meanwhile(running, small_scene):
    simulation, supervisor, control = running
    ask(simulation, control, scene=str(small_scene))
    supervisor.waiting = ["tissue_deformer"]
    simulation.update()  # which loads it
    simulation.update()
    assert "no images" in control.told[-1][0]
    supervisor.waiting = []
    simulation.update()
    assert control.told[-1][0] == "running"


def test_a_scene_s_own_recording_is_played_to_its_tracker_and_held_at_its_end():
    scene = load_scene("upper_arm_path")
    plan = make_plan(RunRequest(scene))
    played = plan.processes[-1].parameters
    assert (plan.nodes[-1], played["path"], played["stay"]) == ("path_player", PATH, True)
    assert make_plan(RunRequest(scene, by_hand=True)).nodes == plan.nodes[:-1]
    without = replace(scene, tracker=replace(scene.tracker, file=None))
    with pytest.raises(UsSimError, match="tracker"):
        make_plan(RunRequest(without))


def test_what_a_person_chose_beside_the_exercise_goes_to_the_scorer():
    request = RunRequest(
        load_scene("exercise:examination#7"), {"tissue_deformer": {"solver": "fem"}}
    )
    [scorer] = [each for each in make_plan(request).processes if each.node == "scorer"]
    assert scorer.parameters["chosen"] == ["tissue_deformer.solver = fem", "scene.seed = 7"]
    drawn = make_plan(RunRequest(load_scene("exercise:examination")))
    assert not any("chosen" in each.parameters for each in drawn.processes)


def test_an_arm_is_known_once_a_recording_was_played_in_place_of_it():
    drawn = RunRequest(load_scene("exercise:examination"))
    assert drawn.without_replay().scene.is_drawn
    assert not replace(drawn, everything=True).without_replay().scene.is_drawn


def test_all_scenes_are_listed_once_that_which_runs_first(running, small_scene):
    simulation, _, control = running
    for _ in range(40):
        simulation.update()
    assert control.scenes[0].origin == str(small_scene)
    assert len({scene.origin for scene in control.scenes}) == len(control.scenes) > 5


@pytest.mark.parametrize("recordings", ["work/rec", "rec"])
def test_every_recording_of_a_folder_is_offered_once_the_newest_first(
    tmp_path, monkeypatch, recordings
):
    (tmp_path / "work" / "split").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "work")
    folder = tmp_path / recordings
    folder.mkdir()
    BagWriter(folder / "t1.mcap").close()
    BagWriter(folder / "t2.mcap", sidecar=False).close()
    BagWriter(tmp_path / "work" / "split" / "a.mcap").close()
    for age, name in enumerate(["work/split", f"{recordings}/t1.mcap", f"{recordings}/t2.mcap"]):
        os.utime(tmp_path / name, (age, age))
    offered = list_bags(str(folder))
    own = [name for name, file in offered.items() if str(tmp_path) in file]
    assert [name for name in own if name != "rec"] == ["rec/t2.mcap", "rec/t1.mcap", "split"]
    assert len(offered) == len({*offered.values()})
