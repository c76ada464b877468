"""The supervisor restarts nodes that end, here without any process."""

from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from us_sim.errors import SettingsError, UsSimError
from us_sim.nodes import INTERRUPTED
from us_sim.recording.writer import BagWriter
from us_sim.run.plan import NodeProcess, Plan, RunRequest, make_plan
from us_sim.run.supervision import (
    RESTART_S,
    START_S,
    Outcome,
    SupervisionSettings,
    Supervisor,
    continue_process,
    count_images,
)
from us_sim.scene.reading import load_scene
from us_sim.share import find_bag


class Node:
    """A process on paper: the test says how it ends."""

    def __init__(self, node, *_, **__):
        STARTED.append(node)
        self.node, self.pid, self.status = node, len(STARTED), None
        self.complaint, self.last_words, self.is_noted = "", f"{node.node} was here", False
        self.reports, self.heard_at = -1, 0.0

    def note_end(self):
        self.is_noted = True


STARTED: list[NodeProcess] = []


class Monitor:
    """A monitor whose nodes report at once, without any process."""

    def __init__(self):
        self.told = []
        self.silent = set()
        self.running = {}
        self.reports, self.messages, self.recordings = {}, {}, {}
        self.heard = Counter()
        self.report_losses = self.told.append
        self.dropped = 0

    def count_messages(self, _, topic):
        return self.dropped if topic == "dropped" else 7

    def follow_nodes(self, _):
        pass

    def resolve_topic_name(self, topic):
        return f"/{topic}"

    def spin_once(self, **_):
        for node, process in self.running.items():
            if process.status is None and node not in self.silent:
                self.heard[node, process.pid] += 1
                self.reports.setdefault(node, {})["pid"] = str(process.pid)


def listen(supervisor, _):
    supervisor.monitor = supervisor._executor = Monitor()
    supervisor.monitor.running = supervisor._running


@pytest.fixture(autouse=True)
def killed(monkeypatch):
    """Names of nodes that do not end when they are told to."""
    names: set[str] = set()

    def end(nodes, *_):
        for each in nodes:
            each.status, each.is_noted = -15, True
        return [each.node.node for each in nodes if each.node.node in names]

    STARTED.clear()
    monkeypatch.setattr("us_sim.run.supervision.RunningNode", Node)
    monkeypatch.setattr(Supervisor, "_listen", listen)
    monkeypatch.setattr("us_sim.run.supervision.end_nodes", end)
    return names


def supervised(plan, **settings):
    """Return a supervisor that runs the plan, its processes by node, and its monitor."""
    supervisor = Supervisor(SupervisionSettings(**settings))
    supervisor.start_plan(plan)
    return supervisor, supervisor._running, supervisor.monitor


@pytest.fixture
def session(tmp_path):
    processes = [
        NodeProcess("session_recorder", {"file": str(tmp_path / "session.mcap")}),
        NodeProcess("slice_interpolator"),
        NodeProcess("path_player"),
    ]
    return supervised(Plan(processes, poses=600), restarts=2)


def test_a_player_at_its_end_is_no_loss(session):
    supervisor, running, _ = session
    supervisor.update()
    running["path_player"].status = 0
    supervisor.update()
    assert supervisor.finished
    assert not supervisor.losses
    assert supervisor.make_outcome().describe_losses() == ""


@pytest.mark.parametrize(
    ("settings", "lost"),
    [
        ({}, True),
        ({"exclude": ["/ultrasound/image"]}, False),
        ({"topics": ["/probe/pose"]}, False),
        ({"paused": True}, False),
    ],
)
def test_images_that_were_not_to_be_recorded_are_not_lost(tmp_path, settings, lost):
    file = str(tmp_path / "a.mcap")
    recorder = NodeProcess("session_recorder", {"file": file} | settings)
    plan = Plan([recorder, NodeProcess("slice_interpolator")])
    supervisor, _, monitor = supervised(plan)
    monitor.recordings[file] = 1
    assert bool(supervisor.make_outcome().describe_losses()) is lost


def test_a_path_that_was_never_played_is_a_loss(session):
    supervisor, _, monitor = session
    monitor.reports["path_player"] = {"awaited": "the end of days"}
    assert "the end of days" in supervisor.make_outcome().describe_losses()


@pytest.mark.parametrize("status", [0, -9, INTERRUPTED])
def test_any_other_end_is(session, status, capsys):
    supervisor, running, monitor = session
    supervisor.update()
    running["slice_interpolator"].status = status
    supervisor.update()
    (loss,) = supervisor.losses
    assert loss.node == "slice_interpolator"
    assert "slice_interpolator was here" in capsys.readouterr().err
    assert [process.node for process in STARTED[3:]] == ["slice_interpolator"]
    supervisor.update()
    assert loss.back_after_s is not None
    assert not supervisor.finished
    assert monitor.told[-1] == [str(loss)]


def test_a_node_that_is_not_back_in_the_end_is_said(session):
    supervisor, running, _ = session
    supervisor.update()
    running["slice_interpolator"].status = -9
    supervisor.update()
    supervisor.end_plan()
    assert "was not back" in supervisor.make_outcome().describe_losses()


def test_one_that_was_never_ready_ends_all_unless_a_signal_ended_it(session):
    supervisor, running, monitor = session
    monitor.silent = {"slice_interpolator"}
    supervisor.update()
    for status in (-15, 0, INTERRUPTED):
        if len(supervisor.losses) < 2:
            running["slice_interpolator"].status = status
            supervisor.update()
    assert supervisor.waiting == ["slice_interpolator"]
    running["slice_interpolator"].status = 1
    with pytest.raises(UsSimError, match="slice_interpolator ended with status 1"):
        supervisor.update()


def test_the_rest_goes_on_without_one_that_is_given_up(session):
    supervisor, running, _ = session
    supervisor.update()
    for _ in range(3):
        running["slice_interpolator"].status = -11
        supervisor.update()
    assert len(STARTED) == 3 + 2
    assert supervisor.losses[-1].given_up == "is not started again after 2 restarts"
    assert "was ended by SIGSEGV" in supervisor.make_outcome().describe_losses()
    assert not supervisor.finished


def test_a_node_that_is_given_up_before_all_are_ready_ends_all(session):
    supervisor, running, monitor = session
    monitor.silent = {"path_player"}
    for _ in range(2):
        running["slice_interpolator"].status = -11
        supervisor.update()
    running["slice_interpolator"].status = -11
    with pytest.raises(UsSimError, match="after 2 restarts"):
        supervisor.update()


def test_without_its_player_the_run_is_over(session):
    supervisor, running, monitor = session
    supervisor.update()
    monitor.reports["path_player"] |= {"begun": "1700000000.5", "played": "120"}
    for _ in range(3):
        assert not supervisor.finished
        running["path_player"].status = INTERRUPTED
        supervisor.update()
    assert supervisor.losses[-1].given_up
    assert supervisor.finished
    assert STARTED[3].parameters["begun"] == 1700000000.5


def test_a_recorder_goes_on_in_a_further_file_and_all_of_its_own_are_told(session, tmp_path):
    supervisor, running, monitor = session
    supervisor.update()
    running["session_recorder"].status = -9
    supervisor.update()
    again = STARTED[3].parameters
    assert (again["file"], again["if_exists"]) == (str(tmp_path / "session.mcap"), "further")
    monitor.recordings |= {"session.mcap": 1, "session_1.mcap": 4, "of_a_stranger.mcap": 77}
    monitor.dropped = 3
    outcome = supervisor.make_outcome()
    assert [file.name for file in outcome.files] == ["session.mcap", "session_1.mcap"]
    assert "0 images were recorded of 7" in outcome.describe_losses()
    assert "3 messages not recorded" in outcome.describe_losses()
    assert outcome.describe_losses().endswith("the recording is in session.mcap, session_1.mcap")


def test_a_recorder_that_had_to_be_killed_is_a_loss(session, killed):
    supervisor, _, _ = session
    supervisor.update()
    killed.add("path_player")
    supervisor.end_plan()
    assert not supervisor.losses
    killed.add("session_recorder")
    supervisor.end_plan()
    assert "was killed" in supervisor.make_outcome().describe_losses()


def test_a_node_of_another_simulation_is_told_once(session, capsys):
    supervisor, _, monitor = session
    supervisor.update()
    monitor.heard["slice_interpolator", 77] += 1
    supervisor.update()
    supervisor.update()
    assert capsys.readouterr().err.count("ROS_DOMAIN_ID") == 1


def test_another_plan_ends_what_it_lacks_and_then_starts_what_is_new(session):
    supervisor, running, monitor = session
    supervisor.update()
    before = dict(running)
    scene = NodeProcess("slice_interpolator", {"scene": "other"})
    skin = NodeProcess("skin_deformer", {"scene": "other"})
    file = STARTED[0].parameters["file"]
    recorder = NodeProcess("session_recorder", {"file": file, "parameters": "others'"})
    supervisor.change_plan(Plan([recorder, scene, skin]))
    assert {node for node, each in before.items() if each.is_noted} == {
        "slice_interpolator",
        "path_player",
    }
    assert set(supervisor.waiting) == {"slice_interpolator", "skin_deformer"}
    assert STARTED[3:] == [scene, skin]
    assert running["session_recorder"] is before["session_recorder"]
    supervisor.update()
    assert supervisor.waiting == []
    assert not supervisor.losses
    # How many images were made while something was recorded is not known then.
    monitor.recordings[str(file)] = 1
    assert supervisor.make_outcome().describe_losses() == ""


@pytest.mark.parametrize(
    ("given", "awaited"),
    [
        ({}, {"tracker/pose", "probe/pose", "ultrasound/image", "tissue/nodes", "skin/nodes"}),
        ({"topics": "[/probe/pose, /ultrasound/labels]"}, {"probe/pose"}),
        (
            {"exclude": "[/ultrasound/image, /tissue/nodes, /diagnostics]"},
            {"tracker/pose", "probe/pose", "skin/nodes"},
        ),
    ],
)
def test_a_player_waits_for_the_recorder_to_record_what_it_is_to_record(tmp_path, given, awaited):
    parameters = {"session_recorder": given}
    path = find_bag("press_and_slide.mcap")
    request = RunRequest(load_scene("upper_arm"), parameters, tmp_path / "a.mcap", path)
    for asked, expected in (
        (request, awaited),
        (replace(request, record=None, parameters={}), set()),
    ):
        player = make_plan(asked).processes[-1]
        assert player.node == "path_player"
        assert set(player.parameters["await_recorded"]) - {""} == expected


@pytest.fixture
def clock(monkeypatch):
    """A clock that the test moves, before the supervisor is made."""
    now = SimpleNamespace(s=0.0)
    monkeypatch.setattr("us_sim.run.supervision.time.monotonic", lambda: now.s)
    return now


def pass_time(supervisor, clock, seconds, step=0.1):
    """Look again and again until something is lost; return after how long, and that."""
    before, until = len(supervisor.losses), clock.s + seconds
    while clock.s < until and len(supervisor.losses) == before:
        clock.s += step
        supervisor.update()
    return clock.s, [loss.what for loss in supervisor.losses[before:]]


def test_a_node_that_reports_never_hangs(clock, session):
    assert pass_time(session[0], clock, 1000.0, step=0.5)[1] == []


def test_a_silent_one_hangs_and_is_started_again(clock, session):
    supervisor, running, monitor = session
    supervisor.update()
    monitor.silent = {"slice_interpolator"}
    silent = running["slice_interpolator"]
    when, lost = pass_time(supervisor, clock, 100.0)
    assert when == pytest.approx(30.0, abs=0.25)
    assert lost == ["has not reported for 30 s"]
    assert silent.is_noted
    # The process that takes its place may prepare for long, but not as long as a first one.
    assert pass_time(supervisor, clock, RESTART_S - 1.0, step=0.5)[1] == []
    assert pass_time(supervisor, clock, 2.0, step=0.5)[1] == ["has not reported for 120 s"]


def test_one_that_never_reports_ends_all(clock, session):
    supervisor, _, monitor = session
    monitor.silent = {"slice_interpolator"}
    with pytest.raises(UsSimError, match="did not start"):
        pass_time(supervisor, clock, START_S + 1.0, step=0.5)


def test_time_in_which_nobody_looked_is_no_silence(clock, session):
    supervisor, _, monitor = session
    supervisor.update()
    monitor.silent = {"slice_interpolator"}
    assert pass_time(supervisor, clock, 15 * 3600.0, step=3600.0)[1] == []  # a laptop was closed
    assert pass_time(supervisor, clock, 30.0)[1]


@pytest.mark.parametrize("wrong", [{"restarts": -1}, {"silence": "1 s"}])
def test_supervision_that_cannot_be_is_refused(wrong):
    with pytest.raises(SettingsError, match="is outside"):
        SupervisionSettings(**wrong)


def test_a_player_goes_on_where_its_path_would_be():
    player = NodeProcess("path_player", {"path": "a.mcap"})
    again = continue_process(player, {"played": "120", "begun": "1700000000.250000000"})
    assert again.parameters == {"path": "a.mcap", "begun": 1700000000.25}
    assert continue_process(player, {"state": "waiting"}) is player
    assert continue_process(player, {"begun": "soon"}) is player


def test_a_viewer_goes_on_where_pages_look_for_it():
    viewer = NodeProcess("viewer", {"host": "127.0.0.1", "port": 0})
    assert continue_process(viewer, {"port": "41234"}).parameters["port"] == 41234
    assert continue_process(viewer, {"port": "any"}).parameters["port"] == 0


def test_others_start_as_they_did():
    tissue = NodeProcess("tissue_deformer", {"scene": "upper_arm", "solver": "msds"})
    assert continue_process(tissue, {"state": "ready"}) is tissue


def test_a_sentence_tells_few_losses_one_by_one():
    losses = [f"loss {number}" for number in range(6)]
    assert Outcome(1.0, [], []).describe_losses() == ""
    assert Outcome(1.0, [Path("a.mcap")], []).describe_losses() == ""
    told = Outcome(1.0, [Path("/tmp/a.mcap")], losses).describe_losses()
    assert told.startswith("loss 0; loss 1; loss 2; loss 3; and 2 more")
    assert told.endswith("a.mcap")


def test_images_are_counted_in_all_files_and_a_broken_one_has_none(tmp_path):
    files = [tmp_path / "session.mcap", tmp_path / "session_1.mcap"]
    for count, file in enumerate(files, start=3):
        with BagWriter(file, sidecar=False) as writer:
            writer.add_topic("/ultrasound/image", "std_msgs/msg/Empty")
            for stamp in range(count):
                writer.write_message("/ultrasound/image", bytes(5), stamp)
    empty = tmp_path / "empty.mcap"
    empty.touch()
    assert count_images([*files, empty], "/ultrasound/image") == 3 + 4
