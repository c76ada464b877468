"""Recordings that were killed, cut or damaged: what is left is read, the rest counted."""

import sqlite3

import pytest
from killed import kill_once
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader
from session_files import EPOCH, STRING, text

from us_sim.command.main import main
from us_sim.errors import BagError
from us_sim.recording.reader import read_bag
from us_sim.recording.repair import extract, repair
from us_sim.recording.topic import DEFAULT_QOS
from us_sim.recording.writer import BagWriter


@pytest.fixture
def session(tmp_path):
    """A recording with three chunks, an attachment, a marker and a loss."""
    file = tmp_path / "session.mcap"
    with BagWriter(file) as bag:
        bag.add_topic("/note", STRING, [DEFAULT_QOS._replace(depth=3)])
        bag.attach("scene.yaml", "application/yaml", b"name: arm\n", EPOCH)
        bag.attach("camera.yaml", "application/yaml", b"width: 640\n", EPOCH)
        bag.add_topic("/session/marker", STRING, [])
        for k in range(20):
            bag.write("/note", text(f"{k}"), EPOCH + k * 10**8)
            if k == 10:
                bag.flush()
            if k == 5:
                bag.write("/session/marker", text("needle in"), EPOCH + 5 * 10**8)
            if k == 15:
                bag.note("messages_lost", {"/note": "2"})
                bag.note("messages_lost", {"/note": "1"})
    return file


@pytest.mark.slow
@pytest.mark.parametrize("compression", ["none", "zstd"])
@pytest.mark.parametrize("after", [0.0, 0.9])
def test_a_killed_recording_lacks_less_than_a_second_and_is_repaired(tmp_path, after, compression):
    kill_once(tmp_path, after, compression)


def test_a_cut_recording_is_made_whole(session, tmp_path):
    content = session.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(content[: content.index(b"messages_lost") + 200])
    made = repair(cut, tmp_path / "whole")
    assert len(made.faults) == 1
    assert "was not ended properly" in made.faults[0].text
    whole = read_bag(tmp_path / "whole")
    assert not whole.note
    assert list(whole.messages()) == list(read_bag(cut).messages())
    assert made.message_count == whole.message_count == 12  # in whole chunks
    assert whole.topic("/note").qos == (DEFAULT_QOS._replace(depth=3),)
    assert whole.attachments.keys() == {"scene.yaml", "camera.yaml"}
    assert whole.markers() == [(EPOCH + 5 * 10**8, "needle in")]
    assert cut.read_bytes() == content[: len(cut.read_bytes())]  # untouched


def test_a_damaged_chunk_is_left_out_and_said(session, tmp_path):
    content = bytearray(session.read_bytes())
    with session.open("rb") as stream:
        first, *_ = make_reader(stream).get_summary().chunk_indexes
    content[first.chunk_start_offset + first.chunk_length - 3] ^= 1
    session.write_bytes(content)
    made = repair(session, tmp_path / "whole")
    assert [m.log_time for m in read_bag(made.path).messages()] == [
        EPOCH + k * 10**8 for k in range(11, 20)
    ]
    assert "is damaged in its chunk" in made.faults[0].text
    assert made.faults[0].messages == 12


@pytest.mark.parametrize("at", [33, 60])
def test_without_an_index_a_damaged_chunk_is_left_out(session, tmp_path, at):
    with session.open("rb") as stream:
        _, second, _ = make_reader(stream).get_summary().chunk_indexes
    content = bytearray(session.read_bytes())
    content[second.chunk_start_offset + at] ^= 16
    session.write_bytes(content[: content.rindex(b"\x0f\x04")])
    made = repair(session, tmp_path / "whole")
    assert made.message_count == 16
    assert "is damaged in its record" in made.faults[0].text


def test_an_attached_recording_that_is_cut_is_not_taken_for_the_recording(session, tmp_path):
    file = tmp_path / "other.mcap"
    with BagWriter(file, sidecar=False) as bag:
        bag.add_topic("/other", STRING)
        bag.attach("session.mcap", "application/octet-stream", session.read_bytes(), EPOCH)
    content = file.read_bytes()
    for damaged in (
        content[: content.index(b"messages_lost") + 200],
        content.replace(b"needle", b"noodle"),
    ):
        file.write_bytes(damaged)
        assert read_bag(file).message_count == 0


def test_a_damaged_attachment_is_left_out_and_said(session, tmp_path, capsys):
    content = session.read_bytes().replace(b"width: 640", b"width: 641", 1)
    session.write_bytes(content)
    made = repair(session, tmp_path / "whole")
    assert read_bag(made.path).attachments.keys() == {"scene.yaml"}
    assert "camera.yaml" in made.faults[0].text
    assert main(["bag", "extract", str(session), "--out", str(tmp_path / "out")]) != 0
    assert "camera.yaml" in capsys.readouterr().err
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["scene.yaml"]
    assert "camera.yaml" in read_bag(session).note


def test_the_files_of_a_restarted_recorder_become_one_bag(session, tmp_path):
    content = session.read_bytes()
    (tmp_path / "metadata.yaml").unlink()
    session.write_bytes(content[: len(content) // 2])
    with BagWriter(session, further=True) as bag:
        bag.add_topic("/note", STRING)
        bag.write("/note", text("later"), EPOCH + 10**10)
    assert bag.path == tmp_path / "session_1.mcap"
    assert repair(tmp_path, tmp_path / "whole").message_count == 18


def test_the_commands(session, tmp_path, capsys):
    assert main(["bag", "info", str(session)]) == 0
    told = capsys.readouterr().out
    for line in ("3 of /note", "0.500 s  needle in", "scene.yaml (10 bytes)"):
        assert f"  {line}\n" in f"{told}\n"
    assert main(["bag", "extract", str(session), "--out", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out/camera.yaml").read_text() == "width: 640\n"
    assert main(["bag", "extract", str(session), "--out", str(tmp_path / "out")]) != 0
    assert "exists already: choose another folder" in capsys.readouterr().err
    assert main(["bag", "repair", str(session)]) == 0
    whole = tmp_path / "session_repaired"
    assert f"21 messages are in {whole}/session_repaired_0.mcap" in capsys.readouterr().out
    assert main(["bag", "repair", str(session)]) != 0
    assert "exists already" in capsys.readouterr().err


def test_messages_of_a_type_that_nobody_defines_are_kept(tmp_path):
    database = sqlite3.connect(tmp_path / "foreign.db3")
    database.executescript(
        "CREATE TABLE topics(id INTEGER, name TEXT, type TEXT, serialization_format TEXT);"
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data);"
        "INSERT INTO topics VALUES (1, '/call', 'some_interfaces/srv/Add_Event', 'cdr');"
        f"INSERT INTO messages VALUES (1, 1, {EPOCH}, x'00010000'), (2, 1, {EPOCH + 1}, x'0001');"
    )
    database.close()
    made = repair(tmp_path / "foreign.db3", tmp_path / "whole")
    assert (made.message_count, made.faults) == (2, ())
    with Reader(tmp_path / "whole") as other:  # of rosbags
        assert [data for _, _, data in other.messages()] == [b"\0\1\0\0", b"\0\1"]
    again = repair(made.path, tmp_path / "again")
    assert list(read_bag(again.path).messages()) == list(read_bag(made.path).messages())


@pytest.mark.parametrize(("name", "count"), [("talker", 20), ("topics_and_services", 13)])
def test_all_of_a_foreign_database_is_kept(shared_data, tmp_path, name, count):
    made = repair(shared_data / f"foreign-files/{name}.db3", tmp_path / "whole")
    assert (made.message_count, made.faults) == (count, ())


@pytest.mark.parametrize("name", ["", "..", "/etc/passwd", "c:\\x", "x\ny", None])
def test_an_attachment_goes_nowhere_but_into_the_folder(tmp_path, name):
    with BagWriter(tmp_path / "bag.mcap") as bag:
        if name is not None:
            bag.attach(name, "text/plain", b"harm", EPOCH)
    with pytest.raises(BagError, match="no files" if name is None else "not a file's name"):
        extract(tmp_path / "bag.mcap", tmp_path / "out")
    assert not (tmp_path / "out").exists()
