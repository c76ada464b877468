"""MCAP files against mcap's own reader, and reading from a time on."""

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from session_files import EPOCH, HI, STRING

from us_sim.recording import mcap_storage
from us_sim.recording.reader import read_bag
from us_sim.recording.writer import BagWriter


def session(path, compression="none", count=400):
    """Messages of two topics, and of a third one that is rare."""
    with BagWriter(path, compression=compression, chunk_size=500, sidecar=False) as bag:
        for topic in ("/a", "/b", "/rare"):
            bag.add_topic(topic, STRING)
        for k in range(count):
            topic = "/rare" if k % 150 == 7 else "/b" if k % 5 == 0 else "/a"
            bag.write_message(topic, HI + bytes([k % 256]), EPOCH + k * 10**7, EPOCH + k, k)
    return path


def foreign(path, compression=CompressionType.LZ4, use_chunking=True):
    """A file of mcap's own writer, whose chunks overlap in time."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=400, compression=compression, use_chunking=use_chunking)
        writer.start(profile="ros2")
        schema = writer.register_schema(STRING, "ros2msg", b"string data")
        topics = [writer.register_channel(name, "cdr", schema) for name in ("/a", "/b", "/rare")]
        for k in range(300):
            time = EPOCH + (k + 9 * (k % 4)) * 10**7
            writer.add_message(topics[2 if k % 90 == 8 else k % 2], time, HI + bytes([k % 256]), k)
        writer.finish()
    return path


FILES = {
    "ours": session,
    "zstd": lambda path: session(path, "zstd"),
    "lz4 by mcap": foreign,
    "zstd by mcap": lambda path: foreign(path, CompressionType.ZSTD),
    "without chunks": lambda path: foreign(path, CompressionType.NONE, use_chunking=False),
}


@pytest.fixture(params=[*FILES, "cut", "sqlite3"])
def file(request, tmp_path, shared_data):
    if request.param == "sqlite3":
        return shared_data / "ros2-jazzy/bags/probe_path_sqlite3"
    if request.param == "cut":
        made = session(tmp_path / "s.mcap")
        made.write_bytes(made.read_bytes()[:-2000])
        return made
    return FILES[request.param](tmp_path / "s.mcap")


def by_mcap(path):
    with path.open("rb") as stream:
        return [
            (channel.topic, m.log_time, m.publish_time, m.data, m.sequence)
            for _, channel, m in make_reader(stream).iter_messages()
        ]


@pytest.mark.parametrize("name", FILES)
def test_everything_is_as_mcap_reads_it(tmp_path, name):
    path = FILES[name](tmp_path / "s.mcap")
    bag = read_bag(path)
    assert [(m.topic, *m[2:]) for m in bag.read_messages()] == by_mcap(path)


def test_messages_are_read_from_a_time_on_and_the_latest_before_it(file):
    bag = read_bag(file)
    every = list(bag.read_messages())
    rare, often = min((t for t in bag.topics), key=lambda t: t.message_count).name, every[0].topic
    times = [message.log_time for message in every]
    for since in (0, times[0], times[1] - 1, times[100], times[170], times[-1], times[-1] + 1):
        later = [m for m in every if m.log_time >= since]
        assert list(bag.read_messages(since=since)) == later
        assert list(bag.read_messages([rare], since=since)) == [m for m in later if m.topic == rare]
        for count in (1, 3):
            found = bag.read_latest([rare, often], since, count)
            for topic in {rare, often}:
                earlier = [m for m in every if m.topic == topic and m.log_time < since]
                assert [m for m in found if m.topic == topic] == earlier[-count:]


def test_seeking_reads_one_chunk(tmp_path, monkeypatch):
    bag = read_bag(session(tmp_path / "s.mcap"))
    read = []
    messages = mcap_storage._messages
    monkeypatch.setattr(
        mcap_storage, "_messages", lambda *given: (read.append(given), messages(*given))[1]
    )
    since = EPOCH + 250 * 10**7
    assert next(bag.read_messages(since=since)).log_time == since
    assert len(read) == 1
    (last,) = bag.read_latest(["/rare"], since, 1)
    assert last.log_time == EPOCH + 157 * 10**7
    assert len(read) <= 5  # those with rare messages


def test_a_damaged_chunk_before_a_time_does_not_matter(tmp_path):
    path = session(tmp_path / "s.mcap")
    content = bytearray(path.read_bytes())
    content[content.index(HI + bytes([100]))] ^= 1
    path.write_bytes(content)
    bag, damage = read_bag(path), []
    since = EPOCH + 250 * 10**7
    assert len(list(bag.read_messages(damage=damage, since=since))) == 150
    assert damage == []
    assert len(list(bag.read_messages(damage=damage, since=0))) < 400
    assert "is damaged in its chunk" in damage[0]
