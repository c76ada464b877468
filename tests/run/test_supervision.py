"""The supervisor restarts nodes that end, here without any process."""

from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import pytest

from us_sim.errors import SettingsError, UsSimError
from us_sim.nodes import INTERRUPTED
from us_sim.recording.writer import BagWriter
from us_sim.run.plan import NodeProcess, Plan, Request, plan_of
from us_sim.run.supervision import (
    START_S,
    Loss,
    Outcome,
    SupervisionSettings,
    Supervisor,
    files_of,
    going_on,
    images_in,
)
from us_sim.scene.reading import load_scene
from us_sim.share import find_bag


class Group:
    """Processes on paper: the test says which end, and how."""

    def __init__(self):
        self.pids = {}
        self.running = set()
        self.started = []
        self.ended = {}
        self.ended_by_us = []
        self.killed = []

    def start(self, processes):
        for process in processes:
            self.started.append(process)
            self.pids[process.node] = len(self.started)
            self.running.add(process.node)

    def take_ended(self):
        ended, self.ended = self.ended, {}
        return ended

    def is_running(self, node):
        return node in self.running

    def last_words(self, node):
        return f"{node} was here"

    def failure(self, node, status):
        return UsSimError(f"{node} cannot work ({status})")

    def end(self, nodes):
        self.running -= {*nodes}
        self.ended_by_us += nodes
        return self.killed

    def stop(self):
        return self.killed


class Monitor:
    """A monitor whose nodes report at once, without any process."""

    def __init__(self, group):
        self.group = group
        self.told = []
        self.silent = set()
        self.node = SimpleNamespace(
            reports={}, messages={}, heard=Counter(), tell_lost=self.told.append, count=lambda *_: 7
        )
        self.node.rejected = lambda node, kind: self.problems.get((node, kind), 0)
        self.problems = {}
        self.node.follow = lambda _: None
        self.node.resolve_topic_name = lambda topic: f"/{topic}"

    def spin(self, _=0.1):
        for node in self.group.running - self.silent:
            self.node.heard[node, self.group.pids[node]] += 1
            self.node.reports.setdefault(node, {})["pid"] = str(self.group.pids[node])


@pytest.fixture
def session(tmp_path):
    group = Group()
    monitor = Monitor(group)
    processes = [
        NodeProcess("session_recorder", {"file": str(tmp_path / "session.mcap")}),
        NodeProcess("slice_interpolator"),
        NodeProcess("path_player"),
    ]
    plan = Plan(processes, poses=600)
    return Supervisor(plan, group, monitor, SupervisionSettings(restarts=2)), group, monitor


def test_a_player_at_its_end_is_no_loss(session):
    supervisor, group, _ = session
    supervisor.update()
    group.ended = {"path_player": 0}
    supervisor.update()
    assert supervisor.finished
    assert not supervisor.losses
    assert supervisor.outcome(1.0).sentence() == ""


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
    group = Group()
    recorder = NodeProcess("session_recorder", {"file": str(tmp_path / "a.mcap")} | settings)
    plan = Plan([recorder, NodeProcess("slice_interpolator")])
    supervisor = Supervisor(plan, group, Monitor(group), SupervisionSettings())
    (tmp_path / "a.mcap").touch()
    assert bool(supervisor.outcome(1.0).sentence()) is lost


def test_a_path_that_was_never_played_is_a_loss(session):
    supervisor, _, monitor = session
    monitor.node.reports["path_player"] = {"awaited": "the end of days"}
    assert "the end of days" in supervisor.outcome(1.0).sentence()


@pytest.mark.parametrize("status", [0, -9, INTERRUPTED])
def test_any_other_end_is(session, status):
    supervisor, group, monitor = session
    supervisor.update()
    group.ended = {"slice_interpolator": status}
    supervisor.update()
    (loss,) = supervisor.losses
    assert (loss.node, loss.last_words) == ("slice_interpolator", "slice_interpolator was here")
    assert [process.node for process in group.started[3:]] == ["slice_interpolator"]
    supervisor.update()
    assert loss.back_after_s is not None
    assert not supervisor.finished
    assert monitor.told[-1] == [str(loss)]


def test_a_node_that_is_not_back_in_the_end_is_said(session):
    supervisor, group, _ = session
    supervisor.update()
    group.ended = {"slice_interpolator": -9}
    supervisor.update()
    supervisor.end()
    assert "was not back" in supervisor.outcome(1.0).sentence()


def test_one_that_was_never_ready_ends_all_unless_a_signal_ended_it(session):
    supervisor, group, monitor = session
    monitor.silent = {"slice_interpolator"}
    supervisor.update()
    for status in (-15, 0, INTERRUPTED):
        if len(supervisor.losses) < 2:
            group.ended = {"slice_interpolator": status}
            supervisor.update()
    assert supervisor.waiting == ["slice_interpolator"]
    group.ended = {"slice_interpolator": 1}
    with pytest.raises(UsSimError, match="slice_interpolator cannot work"):
        supervisor.update()


def test_the_rest_goes_on_without_one_that_is_given_up(session):
    supervisor, group, _ = session
    supervisor.update()
    for _ in range(3):
        group.ended = {"slice_interpolator": -11}
        supervisor.update()
    assert len(group.started) == 3 + 2
    assert supervisor.losses[-1].given_up == "is not started again after 2 restarts"
    assert "was ended by SIGSEGV" in supervisor.outcome(1.0).sentence()
    assert not supervisor.finished


def test_without_its_player_the_run_is_over(session):
    supervisor, group, monitor = session
    supervisor.update()
    monitor.node.reports["path_player"] |= {"begun": "1700000000.5", "played": "120"}
    for _ in range(3):
        assert not supervisor.finished
        group.ended = {"path_player": INTERRUPTED}
        supervisor.update()
    assert supervisor.losses[-1].given_up
    assert supervisor.finished
    assert group.started[3].parameters["begun"] == 1700000000.5


def test_a_recorder_goes_on_in_a_further_file_and_all_are_found(session, tmp_path):
    supervisor, group, _ = session
    supervisor.update()
    (tmp_path / "session.mcap").touch()
    group.ended = {"session_recorder": -9}
    supervisor.update()
    again = group.started[3].parameters
    assert (again["file"], again["if_exists"]) == (str(tmp_path / "session.mcap"), "further")
    (tmp_path / "session_1.mcap").touch()
    files = supervisor.outcome(1.0).files
    assert [file.name for file in files] == ["session.mcap", "session_1.mcap"]


def test_a_full_disk_is_told_once(session):
    supervisor, _, monitor = session
    monitor.node.messages["session_recorder"] = "no space left"
    monitor.problems["session_recorder", "disk"] = 1
    supervisor.update()
    supervisor.update()
    (loss,) = supervisor.losses
    assert loss.what == "could not write (no space left)"


def test_a_recorder_that_had_to_be_killed_is_a_loss(session):
    supervisor, group, _ = session
    supervisor.update()
    group.killed = ["path_player"]
    supervisor.end()
    assert not supervisor.losses
    group.killed = ["session_recorder"]
    supervisor.end()
    assert "did not end when it was told to and was killed" in supervisor.outcome(1.0).sentence()


def test_another_plan_ends_what_it_lacks_and_then_starts_what_is_new(session):
    supervisor, group, _ = session
    supervisor.update()
    before = dict(group.pids)
    scene = NodeProcess("slice_interpolator", {"scene": "other"})
    skin = NodeProcess("skin_deformer", {"scene": "other"})
    file = group.started[0].parameters["file"]
    recorder = NodeProcess("session_recorder", {"file": file, "parameters": "others'"})
    supervisor.change(Plan([recorder, scene, skin]))
    assert set(group.ended_by_us) == {"slice_interpolator", "path_player"}
    assert set(supervisor.waiting) == {"slice_interpolator", "skin_deformer"}
    assert group.started[3:] == [scene, skin]
    assert group.pids["session_recorder"] == before["session_recorder"]
    supervisor.update()
    assert supervisor.waiting == []
    assert not supervisor.losses
    # How many images were made while something was recorded is not known then.
    assert supervisor.outcome(1.0).sentence() == ""


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
    request = Request(load_scene("upper_arm"), parameters, tmp_path / "a.mcap", path)
    for asked, expected in (
        (request, awaited),
        (replace(request, record=None, parameters={}), set()),
    ):
        player = plan_of(asked).processes[-1]
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
    supervisor, group, monitor = session
    supervisor.update()
    monitor.silent = {"slice_interpolator"}
    when, lost = pass_time(supervisor, clock, 100.0)
    assert when == pytest.approx(30.0, abs=0.25)
    assert lost == ["has not reported for 30 s"]
    assert group.ended_by_us == ["slice_interpolator"]
    # The process that takes its place may compile for long.
    assert pass_time(supervisor, clock, START_S - 1.0, step=0.5)[1] == []


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


def outcome(losses=(), files=(), **counts):
    counts = {"made": 600, "recorded": 600, "poses": 600} | counts
    return Outcome(1.0, list(losses), list(files), **counts)


@pytest.fixture
def files(tmp_path):
    return [tmp_path / "session.mcap", tmp_path / "session_1.mcap"]


def test_nothing_lost_is_nothing_said(files):
    assert outcome().sentence() == ""
    assert outcome(files=files[:1]).sentence() == ""
    # Poses that a live simulation skips are no loss of the recording's.
    assert outcome(files=files[:1], made=590, recorded=591).sentence() == ""
    assert outcome(made=590, recorded=0).sentence() == ""  # nothing was recorded


def test_images_that_are_not_in_the_recording_are_said(files):
    lacking = outcome(files=files[:1], recorded=64, made=440, poses=None)
    assert lacking.sentence() == (
        "64 images were recorded of 440 that were made; the recording is in session.mcap"
    )


def test_the_summary_has_all_of_it(files):
    loss = Loss("a", "ended with status 3", 1.23, last_words="out of memory", back_after_s=2.0)
    told = outcome([loss], files, recorded=590).summary()
    assert told["images_made"] == 600
    assert told["images_recorded"] == 590
    assert told["files"] == ["session.mcap", "session_1.mcap"]
    (node,) = told["nodes"]
    assert node.pop("time")[:2] == "20"
    assert node == {
        "node": "a",
        "what": "ended with status 3",
        "at_s": 1.23,
        "last_words": "out of memory",
        "back_after_s": 2.0,
        "given_up": "",
    }


def test_the_files_of_a_recording_are_found_in_their_order(tmp_path):
    names = ["a.mcap", "a_1.mcap", "a_2.mcap", "a_2_1.mcap", "a_10.mcap"]
    for name in (*names, "ab.mcap", "a_b.mcap", "a_1.db3", "b_1.mcap"):
        (tmp_path / name).touch()
    assert [file.name for file in files_of(tmp_path / "a.mcap")] == names
    assert files_of(tmp_path / "none.mcap") == []


def test_images_are_counted_in_all_files_and_a_broken_one_has_none(files, tmp_path):
    for count, file in enumerate(files, start=3):
        with BagWriter(file, sidecar=False) as writer:
            writer.add_topic("/ultrasound/image", "std_msgs/msg/Empty")
            for stamp in range(count):
                writer.write("/ultrasound/image", bytes(5), stamp)
    empty = tmp_path / "empty.mcap"
    empty.touch()
    assert images_in([*files, empty], "/ultrasound/image") == 3 + 4
