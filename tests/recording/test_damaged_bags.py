"""Recordings that were killed, cut or damaged: what is left is read, the rest counted."""

import re

import pytest
from killed import kill_once
from mcap.reader import make_reader
from session_files import EPOCH, STRING, text

from us_sim.command.main import main
from us_sim.errors import BagError
from us_sim.recording.attached_files import extract_files
from us_sim.recording.reader import read_bag
from us_sim.recording.topic import DEFAULT_QOS
from us_sim.recording.writer import BagWriter


@pytest.fixture
def session(tmp_path):
    """A recording with three chunks, an attachment, a marker and a loss."""
    file = tmp_path / "session.mcap"
    with BagWriter(file) as bag:
        bag.add_topic("/note", STRING, [DEFAULT_QOS._replace(depth=3)])
        bag.attach_file("scene.yaml", "application/yaml", b"name: arm\n", EPOCH)
        bag.attach_file("camera.yaml", "application/yaml", b"width: 640\n", EPOCH)
        bag.add_topic("/session/marker", STRING, [])
        for k in range(20):
            bag.write_message("/note", text(f"{k}"), EPOCH + k * 10**8)
            if k == 10:
                bag.flush()
            if k == 5:
                bag.write_message("/session/marker", text("needle in"), EPOCH + 5 * 10**8)
            if k == 15:
                bag.write_metadata("messages_lost", {"/note": "2"})
                bag.write_metadata("messages_lost", {"/note": "1"})
    return file


@pytest.mark.slow
@pytest.mark.parametrize("compression", ["none", "zstd"])
@pytest.mark.parametrize("after", [0.0, 0.9])
def test_a_killed_recording_lacks_less_than_a_second(tmp_path, after, compression):
    kill_once(tmp_path, after, compression)


def test_a_cut_recording_is_read_as_far_as_it_goes(session):
    content = session.read_bytes()
    session.write_bytes(content[: content.index(b"messages_lost") + 200])
    cut = read_bag(session)
    assert "was not ended properly" in cut.fault
    assert [m.log_time for m in cut.read_messages(["/note"])] == [
        EPOCH + k * 10**8 for k in range(11)
    ]
    assert cut.message_count == 12  # in whole chunks
    assert cut.find_topic("/note").qos == (DEFAULT_QOS._replace(depth=3),)
    assert cut.attachments.keys() == {"scene.yaml", "camera.yaml"}
    assert cut.read_markers() == [(EPOCH + 5 * 10**8, "needle in")]


def test_a_damaged_chunk_is_left_out_and_said(session):
    content = bytearray(session.read_bytes())
    with session.open("rb") as stream:
        first, *_ = make_reader(stream).get_summary().chunk_indexes
    content[first.chunk_start_offset + first.chunk_length - 3] ^= 1
    session.write_bytes(content)
    damage = []
    assert [m.log_time for m in read_bag(session).read_messages(damage=damage)] == [
        EPOCH + k * 10**8 for k in range(11, 20)
    ]
    assert re.search("is damaged in its chunk.*`mcap recover`", damage[0])
    with pytest.raises(BagError, match="is damaged in its chunk"):
        list(read_bag(session).read_messages())


@pytest.mark.parametrize("at", [33, 60])
def test_without_an_index_a_damaged_chunk_is_left_out(session, at):
    with session.open("rb") as stream:
        _, second, _ = make_reader(stream).get_summary().chunk_indexes
    content = bytearray(session.read_bytes())
    content[second.chunk_start_offset + at] ^= 16
    session.write_bytes(content[: content.rindex(b"\x0f\x04")])
    bag = read_bag(session)
    assert len(list(bag.read_messages())) == bag.message_count == 16
    assert "is damaged" in bag.fault


def test_an_attached_recording_that_is_cut_is_not_taken_for_the_recording(session, tmp_path):
    file = tmp_path / "other.mcap"
    with BagWriter(file, sidecar=False) as bag:
        bag.add_topic("/other", STRING)
        bag.attach_file("session.mcap", "application/octet-stream", session.read_bytes(), EPOCH)
    content = file.read_bytes()
    for damaged in (
        content[: content.index(b"messages_lost") + 200],
        content.replace(b"needle", b"noodle"),
    ):
        file.write_bytes(damaged)
        assert read_bag(file).message_count == 0


def test_the_files_of_a_restarted_recorder_are_one_bag(session, tmp_path):
    content = session.read_bytes()
    session.write_bytes(content[: len(content) // 2])
    with BagWriter(session, further=True) as bag:
        bag.add_topic("/note", STRING)
        bag.write_message("/note", text("later"), EPOCH + 10**10)
    assert bag.path == tmp_path / "session_1.mcap"
    assert len(list(read_bag(tmp_path).read_messages())) == 18


def test_the_commands(session, tmp_path, capsys):
    assert main(["bag", "info", str(session)]) == 0
    told = capsys.readouterr().out
    for line in ("3 of /note", "0.500 s  needle in", "scene.yaml (10 bytes)"):
        assert f"  {line}\n" in f"{told}\n"
    assert main(["bag", "extract", str(session), "--out", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out/camera.yaml").read_text() == "width: 640\n"
    assert main(["bag", "extract", str(session), "--out", str(tmp_path / "out")]) != 0
    assert "exists already: choose another folder" in capsys.readouterr().err


@pytest.mark.parametrize(("name", "count"), [("talker", 20), ("topics_and_services", 13)])
def test_all_of_a_foreign_database_is_read(shared_data, name, count):
    bag = read_bag(shared_data / f"foreign-files/{name}.db3")
    assert len(list(bag.read_messages())) == bag.message_count == count


@pytest.mark.parametrize("name", ["", "..", "/etc/passwd", "c:\\x", "x\ny", None])
def test_an_attachment_goes_nowhere_but_into_the_folder(tmp_path, name):
    with BagWriter(tmp_path / "bag.mcap") as bag:
        if name is not None:
            bag.attach_file(name, "text/plain", b"harm", EPOCH)
    with pytest.raises(BagError, match="no files" if name is None else "not a file's name"):
        extract_files(tmp_path / "bag.mcap", tmp_path / "out")
    assert not (tmp_path / "out").exists()
