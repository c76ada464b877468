"""The recorder's commands, losses, markers and attachments, and what it is asked to survive."""

import dataclasses
import errno
import hashlib
import os
import re
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String
from std_srvs.srv import Trigger

from us_sim.errors import BagError
from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.session_recorder import SessionRecorder
from us_sim.nodes.sessions.recorded_topic import RecordedTopic
from us_sim.recording.attached_files import extract_files
from us_sim.recording.path import ProbePath, write_path
from us_sim.recording.reader import read_bag
from us_sim.recording.topic import DEFAULT_QOS
from us_sim.recording.writer import BagWriter, BufferedFile
from us_sim.scene.building import load_path
from us_sim.scene.reading import load_scene

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def call(bench, name):
    client = bench.peer.create_client(Trigger, f"/session_recorder/{name}")
    bench.spin_until(client.service_is_ready)
    answer = client.call_async(Trigger.Request())
    bench.spin_until(answer.done)
    assert answer.result().success == (not answer.result().message)
    return answer.result().message


def pause(recorder, paused):
    assert recorder.set_parameters([Parameter("paused", value=paused)])[0].successful


def end(bench, recorder):
    bench.executor.remove_node(recorder)
    recorder.destroy_node()


def texts(file, topic="/note"):
    bag = read_bag(file)
    if topic not in {each.name for each in bag.topics}:
        return []
    return [bag.deserialize(message).data for message in bag.read_messages([topic])]


def say(bench, recorder, publisher, *words):
    before = recorder.health.received
    for word in words:
        publisher.publish(String(data=word))
    bench.spin_until(lambda: recorder.health.received >= before + len(words))


@pytest.fixture
def quiet(bench, tmp_path):
    """A recorder of two topics, a publisher of each, the second one latched."""

    def make(**parameters):
        file = tmp_path / "session.mcap"
        recorder = bench.make(
            SessionRecorder, file=str(file), topics=["/note", "/mesh"], **parameters
        )
        note = bench.publisher(String, "note")
        mesh = bench.peer.create_publisher(String, "mesh", LATCHED)
        say(bench, recorder, mesh, "mesh")
        return recorder, note, mesh, file

    return make


def test_pause_and_resume(bench, quiet):
    recorder, note, mesh, file = quiet(paused=True)
    assert recorder.health.state == "paused"
    say(bench, recorder, note, "paused")
    pause(recorder, False)
    assert recorder.health.state == "recording"
    say(bench, recorder, note, "one")
    pause(recorder, True)
    say(bench, recorder, note, "paused again")
    say(bench, recorder, mesh, "other mesh")
    pause(recorder, False)
    say(bench, recorder, note, "two")
    end(bench, recorder)
    assert texts(file) == ["one", "two"]
    assert texts(file, "/mesh") == ["mesh", "other mesh"]  # what came while paused still holds


def test_the_recording_is_stopped_on_command(bench, quiet, tmp_path):
    recorder, note, _, file = quiet()
    say(bench, recorder, note, "one")
    assert not call(bench, "stop")
    assert recorder.health.state == "stopped"
    assert texts(tmp_path) == ["one"]
    say(bench, recorder, note, "nobody records")
    assert call(bench, "stop") == "nothing is recorded any more"
    assert texts(file) == ["one"]


def test_what_waits_at_the_end_is_recorded(bench, tmp_path):
    file = tmp_path / "session.mcap"
    recorder = bench.make(SessionRecorder, file=str(file), topics=["/note"])
    note = bench.publisher(String, "note")
    bench.executor.remove_node(recorder)  # its turn does not come
    for k in range(50):
        note.publish(String(data=str(k)))
    bench.spin_for(10)
    assert not recorder.health.received
    bench.context.shutdown()  # as a signal does
    recorder.destroy_node()
    assert texts(file) == [str(k) for k in range(50)]


def test_a_session_can_be_made_again_from_its_file(bench, tmp_path):
    info = tmp_path / "calibration" / "info.yaml"
    info.parent.mkdir()
    info.write_text("image_width: 640\n")
    scene = tmp_path / "arm.yaml"
    scene.write_text("name: arm\nbased_on: upper_arm\nprobe: {depth: 35 mm}\n")
    file = tmp_path / "out" / "session.mcap"
    recorder = bench.make(
        SessionRecorder,
        file=str(file),
        scene=str(scene),
        attach=[str(info)],
        parameters="tissue_deformer: {ros__parameters: {solver: fem}}\n",
    )
    end(bench, recorder)
    scene_text = scene.read_text()
    scene.unlink()
    made = {path.name: path for path in extract_files(file, tmp_path / "again")}
    assert made["info.yaml"].read_text() == "image_width: 640\n"
    given = yaml.safe_load(made["parameters.yaml"].read_text())
    assert given == {"tissue_deformer": {"ros__parameters": {"solver": "fem"}}}
    assert f"python {sys.version.split()[0]}\n" in made["versions.txt"].read_text()
    again = load_scene(made["scene.yaml"])
    scene.write_text(scene_text)
    assert Path(again.path).read_bytes() == Path(load_scene(scene).path).read_bytes()
    assert Path(again.path).parent == tmp_path / "again"
    replace = dataclasses.replace
    assert replace(again, path=None, origin="") == replace(load_scene(scene), path=None, origin="")


def bag_of(folder, frame, x=0.0, topic="/tracker/pose"):
    stamps = 1_700_000_000_000_000_000 + np.arange(2) * 10**8
    places = np.tile([x, 0.0, 0.0], (2, 1)), np.tile([0.0, 0, 0, 1], (2, 1))
    write_path(folder, ProbePath(topic, frame, stamps, *places))
    return folder


@pytest.mark.parametrize("played", [None, "other"])
def test_the_bag_that_was_played_is_attached_whole(bench, tmp_path, small_scene, played):
    own, other = bag_of(tmp_path / "own", "ndi"), bag_of(tmp_path / "other", "ndi", 0.01)
    scene = tmp_path / "scene.yaml"
    scene.write_text(
        f"based_on: {small_scene}\npath: own\n"
        "tracker: {source: path, file: own, frame: ndi, registration: {position: [0, 0.02, 0]}}\n"
    )
    file, path = tmp_path / "session.mcap", played and str(tmp_path / played)
    end(bench, bench.make(SessionRecorder, file=str(file), scene=str(scene), path=path or ""))
    extract_files(file, tmp_path / "again")
    again = load_scene(tmp_path / "again" / "scene.yaml")
    kept = tmp_path / "again" / (played or "own")
    assert again.path == again.tracker.file == str(kept)
    assert list(read_bag(kept).read_messages()) == list(
        read_bag(other if played else own).read_messages()
    )
    assert not read_bag(kept).fault
    session = bag_of(tmp_path / "probe", "patient", 0.03, "/probe/pose")
    assert load_path(again, session).frame_id == "patient"  # the probe's own
    elsewhere = bag_of(tmp_path / "elsewhere", "moon")
    with pytest.raises(BagError, match=r"'moon'.*'ndi'"):
        load_path(again, elsewhere)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("none.yaml", "No such file"),
        ("pipe", "it is no file"),
        ("~nobody-at-all/a", ""),
    ],
)
def test_what_cannot_be_attached_is_refused(bench, tmp_path, name, why):
    os.mkfifo(tmp_path / "pipe")
    name = name if name.startswith("~") else str(tmp_path / name)
    with pytest.raises(BagError, match=f"cannot be attached.*{why}"):
        bench.make(SessionRecorder, file=str(tmp_path / "a.mcap"), attach=[name])


def test_of_a_large_attachment_there_is_the_checksum(bench, tmp_path):
    large = tmp_path / "large.bin"
    large.write_bytes(bytes(5 << 20))
    file = tmp_path / "a.mcap"
    end(bench, bench.make(SessionRecorder, file=str(file), attach=[str(large)]))
    made = {path.name: path for path in extract_files(file, tmp_path / "out")}
    checksum = hashlib.sha256(bytes(5 << 20)).hexdigest()
    assert made["files.txt"].read_text() == f"{checksum}  {large}\n"
    assert large.name not in made


@pytest.fixture
def may_write(monkeypatch):
    allowed = threading.Event()
    write = BagWriter.write_message
    monkeypatch.setattr(
        BagWriter, "write_message", lambda *arguments: (allowed.wait(30), write(*arguments))
    )
    return allowed


def test_losses_are_told(bench, quiet, may_write):
    recorder, note, _, file = quiet(max_cache_size=1000)
    reports = bench.collect(DiagnosticArray, "diagnostics")
    try:
        say(bench, recorder, note, *("x" * 93 for _ in range(30)))  # 100 bytes each
        bench.spin_until(lambda: recorder.health.problems["lost"] > 0)
        bench.spin_until(
            lambda: any("/note not recorded" in each.status[0].message for each in reports)
        )
    finally:
        may_write.set()
    end(bench, recorder)
    assert 0 < len(texts(file)) < 10
    assert read_bag(file).count_losses() == {"/note": 30 - len(texts(file))}
    assert recorder.health.dropped == 30 - len(texts(file))


OVERWRITING = """
import sys, time
import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_msgs.msg import String

rclpy.init()
node = Node("flood")
publisher = node.create_publisher(String, "note", QoSProfile(depth=1))
while not publisher.get_subscription_count():
    time.sleep(0.01)
publisher.publish(String(data="first"))
time.sleep(1.0)
for k in range(300):
    publisher.publish(String(data=f"{k:03}" + 100_000 * "x"))
time.sleep(0.5)
publisher.publish(String(data="last"))
time.sleep(1.0)
"""


@pytest.mark.slow
def test_what_a_publisher_overwrites_before_it_was_sent_is_counted(bench, tmp_path):
    file = tmp_path / "session.mcap"
    recorder = bench.make(SessionRecorder, file=str(file), topics=["/note"])
    flood = subprocess.Popen([sys.executable, "-c", OVERWRITING])
    try:
        bench.spin_until(lambda: flood.poll() is not None)
    finally:
        flood.kill()
        flood.wait()
    end(bench, recorder)
    assert flood.returncode == 0
    assert texts(file)[-1] == "last"
    assert 2 < len(texts(file)) < 302
    assert read_bag(file).count_losses() == {"/note": 302 - len(texts(file))}


@pytest.mark.slow
def test_each_message_of_publishers_of_every_kind_is_recorded_once(bench, tmp_path):
    file = tmp_path / "session.mcap"
    recorder = bench.make(SessionRecorder, file=str(file), topics=["/note"])
    first = bench.peer.create_publisher(String, "note", LATCHED)
    first.publish(String(data="before"))
    bench.spin_until(lambda: recorder.health.received > 0)
    weak = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    late = bench.peer.create_publisher(String, "note", weak)
    for publisher in (late, first):  # the recorder has followed
        bench.spin_until(lambda publisher=publisher: publisher.get_subscription_count() == 1)
    bench.spin_for(30)
    said = ["before"]
    for k in range(100):
        for name, publisher in (("first", first), ("late", late)):
            said.append(f"{name} {k}")
            publisher.publish(String(data=said[-1]))
        bench.spin_for(1)
    bench.spin_until(lambda: recorder.health.received >= len(said))
    end(bench, recorder)
    assert sorted(texts(file)) == sorted(said)
    document = yaml.safe_load((tmp_path / "metadata.yaml").read_text())
    topic = document["rosbag2_bagfile_information"]["topics_with_message_count"][0]
    profiles = topic["topic_metadata"]["offered_qos_profiles"]
    assert [(each["reliability"], each["durability"]) for each in profiles] == [
        ("reliable", "transient_local"),
        ("best_effort", "volatile"),
    ]


def test_gaps_in_a_publishers_numbers_are_losses(bench):
    lost = []
    topic = RecordedTopic(
        bench.add(GuardedNode("recorder", context=bench.context)),
        "/note",
        "std_msgs/msg/String",
        [DEFAULT_QOS],
        lambda *_: None,
        lambda name, count: lost.append((name, count)),
    )
    for number in (7, 8, 11, None, 12, 12, 20):
        topic._receive(b"", {"source_timestamp": 0, "publication_sequence_number": number})
    assert lost == [("/note", 2), ("/note", 7)]
    for number in (1, 21, 2, 22):  # somebody else has begun, of whom the graph does not tell yet
        topic._receive(b"", {"source_timestamp": 0, "publication_sequence_number": number})
    topic.adopt_offers([DEFAULT_QOS])  # and has ended again
    for number in (30, 32):
        topic._receive(b"", {"source_timestamp": 0, "publication_sequence_number": number})
    assert lost.pop() == ("/note", 1)
    assert len(lost) == 2
    topic.adopt_offers([DEFAULT_QOS, DEFAULT_QOS])  # whose numbers cannot be told apart
    for number in (30, 1, 31):
        topic._receive(b"", {"source_timestamp": 0, "publication_sequence_number": number})
    assert len(lost) == 2


@pytest.mark.slow
def test_a_further_file_is_begun_only_where_that_is_asked_for(bench, tmp_path):
    file = tmp_path / "session.mcap"
    file.write_bytes(b"precious")
    with pytest.raises(BagError, match="exists already"):
        bench.make(SessionRecorder, file=str(file))
    os.utime(file, times=(time.time() - 7200.0,) * 2)
    recorder = bench.make(SessionRecorder, file=str(file), if_exists="further")
    note = recorder.health.values["note"]
    assert "session_1.mcap" in note
    assert re.search(r"72\d\d\.\d s", note)
    end(bench, recorder)
    assert file.read_bytes() == b"precious"
    assert not read_bag(tmp_path / "session_1.mcap").fault


@pytest.mark.slow
def test_a_full_disk_is_said_and_survived(bench, quiet, monkeypatch):
    full = [False]
    flush = BufferedFile.flush

    def flush_unless_full(file):
        if full[0]:
            file.error = OSError(errno.ENOSPC, "No space left on device")
        else:
            flush(file)

    monkeypatch.setattr(BufferedFile, "flush", flush_unless_full)
    monkeypatch.setattr("us_sim.recording.write_behind._RETRY", 0.1)
    recorder, note, _, file = quiet()
    reports = bench.collect(DiagnosticArray, "diagnostics")
    say(bench, recorder, note, "one")
    bench.spin_until(lambda: texts(file) == ["one"])
    full[0] = True
    say(bench, recorder, note, "two")

    def told():
        return [
            status.message
            for report in reports
            for status in report.status
            if status.name == "/session_recorder" and status.level == DiagnosticStatus.ERROR
        ]

    bench.spin_until(lambda: any("No space left on device" in text for text in told()))
    assert recorder.health.problems["disk"] == 1
    full[0] = False
    bench.spin_until(lambda: not recorder.health.warning)
    say(bench, recorder, note, "three")
    end(bench, recorder)
    assert texts(file) == ["one", "two", "three"]
    assert not read_bag(file).count_losses()


def test_a_message_is_recorded_with_the_time_at_which_it_came(bench, tmp_path):
    file = tmp_path / "session.mcap"
    recorder = bench.make(SessionRecorder, file=str(file), topics=["/note"])
    note = bench.publisher(String, "note")
    say(bench, recorder, note, "one")
    bench.executor.remove_node(recorder)  # its turn does not come
    note.publish(String(data="two"))
    time.sleep(1.0)
    recorder.destroy_node()
    _, late = read_bag(file).read_messages()
    assert 0 <= late.log_time - late.publish_time < 5 * 10**8
