"""Reading bags: real ones against rosbags and mcap, cut ones, damaged ones, no bags at all."""

import shutil
import sqlite3
import tracemalloc
from contextlib import closing

import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader
from session_files import EPOCH, HI, STRING

from us_sim.errors import BagError
from us_sim.recording.reader import read_bag
from us_sim.recording.topic import DEFAULT_QOS
from us_sim.recording.writer import BagWriter


def write_session(path, compression="none", chunk_size=2000, count=200):
    with BagWriter(path, compression=compression, chunk_size=chunk_size) as bag:
        for topic in ("/a", "/b"):
            bag.add_topic(topic, STRING)
        for k in range(count):
            bag.write_message(
                "/b" if k % 5 == 0 else "/a", HI + bytes([k]), EPOCH + k * 10**7, EPOCH + k
            )
    return path


def contents_by_mcap(file):
    """Topic, log time, publish time and bytes of each message, as the mcap package reads them."""
    with file.open("rb") as stream:
        return [
            (channel.topic, message.log_time, message.publish_time, message.data)
            for _, channel, message in make_reader(stream).iter_messages()
        ]


@pytest.mark.parametrize("name", ["mcap", "chunkzstd", "sqlite3"])
def test_real_bags_as_rosbags_reads_them(shared_data, name):
    folder = shared_data / f"ros2-jazzy/bags/probe_path_{name}"
    bag = read_bag(folder)
    with AnyReader([folder]) as reader:
        expected = [(c.topic, time, bytes(data)) for c, time, data in reader.messages()]
        assert (bag.start, bag.end + 1) == (reader.start_time, reader.end_time)
        for connection in reader.connections:
            topic = bag.find_topic(connection.topic)
            assert topic.type_name == connection.msgtype
            assert topic.type_hash == connection.digest
            assert topic.message_count == connection.msgcount
            assert [q.depth for q in topic.qos] == [
                q.depth for q in connection.ext.offered_qos_profiles
            ]
    read = [(m.topic, m.log_time, m.data) for m in bag.read_messages()]
    assert read == expected
    assert len(read) == bag.message_count
    assert not bag.fault


@pytest.mark.slow
def test_every_bag_of_rosbag2s_own_tests_is_read_or_refused_in_a_sentence(shared_data):
    root = shared_data / "mcap-rosbag2"
    folders = {file.parent for file in root.rglob("metadata.yaml")} - set(root.rglob("empty_bag"))
    files = set(root.rglob("*.mcap"))
    assert (len(folders), len(files)) == (10, 20)
    for path in sorted(folders | files):
        bag = read_bag(path)
        read = [(m.topic, m.log_time, m.data) for m in bag.read_messages()]
        assert len(read) == bag.message_count > 0
        assert [time for _, time, _ in read] == sorted(time for _, time, _ in read)
        if "wrong_rmw" in str(path):
            with pytest.raises(BagError, match="wrong_format"):
                bag.deserialize(next(bag.read_messages()))
            continue
        parts = [path] if path.is_file() else sorted(path.glob("*.mcap"))
        expected = [content for part in parts for content in contents_by_mcap(part)]
        assert sorted(read) == sorted(content[:2] + content[3:] for content in expected), path
        if path.is_file():
            with Reader(path) as reader:
                by_rosbags = [(c.topic, time, bytes(data)) for c, time, data in reader.messages()]
            assert sorted(read) == sorted(by_rosbags)
        for message in bag.read_messages():
            if message.type_name.endswith("_Event"):
                with pytest.raises(BagError, match="_Event"):
                    bag.deserialize(message)
            else:
                bag.deserialize(message)


def test_known_contents_of_rosbag2s_own_tests(shared_data):
    root = shared_data / "mcap-rosbag2"
    talker = read_bag(root / "rosbag2_py/test/resources/mcap/talker")
    words = [talker.deserialize(message).data for message in talker.read_messages(["/topic"])]
    assert words == [f"Hello, world! {k}" for k in range(10)]
    seek = read_bag(root / "rosbag2_transport/test/resources/mcap/test_bag_for_seek")
    assert [topic.type_name for topic in seek.topics] == ["test_msgs/msg/BasicTypes"]
    assert [seek.deserialize(m).int32_value for m in seek.read_messages()] == [1, 2, 3, 4, 5]
    with pytest.raises(BagError, match=r"holds no bag"):
        read_bag(root / "ros2bag/test/resources/empty_bag")
    with pytest.raises(BagError, match=r"only_services.mcap, only_topics.mcap"):
        read_bag(root / "rosbag2_cpp/test/rosbag2_cpp/bags")


@pytest.fixture(scope="module")
def sessions(tmp_path_factory):
    """Whole files by their compression."""
    folder = tmp_path_factory.mktemp("sessions")
    return {c: write_session(folder / c / "session.mcap", c) for c in ("none", "zstd")}


@settings(max_examples=40, deadline=None)
@given(st.data(), st.sampled_from(["none", "zstd"]))
def test_a_file_cut_anywhere_gives_what_was_before_the_cut(
    tmp_path_factory, sessions, data, compression
):
    content = sessions[compression].read_bytes()
    cut = data.draw(st.integers(1, len(content) - 1))
    file = tmp_path_factory.mktemp("cut") / "session.mcap"
    file.write_bytes(content[:cut])
    if cut < 8:
        with pytest.raises(BagError, match="is not a bag"):
            read_bag(file)
        return
    bag = read_bag(file)
    read = list(bag.read_messages())
    assert read == list(read_bag(sessions[compression]).read_messages())[: len(read)]
    assert bag.message_count == len(read)
    assert bag.fault
    assert f"{len(read)} messages over" in bag.fault


@pytest.fixture(scope="module")
def damageable(shared_data, sessions):
    """Files by kind; the real recorder's chunks have no checksum."""
    real = shared_data / "ros2-jazzy/bags/probe_path_mcap/probe_path_mcap_0.mcap"
    return {"real": real, **sessions}


@settings(max_examples=40, deadline=None)
@given(st.data(), st.sampled_from(["none", "zstd", "real"]))
def test_no_damage_leads_to_anything_but_a_sentence(tmp_path_factory, damageable, data, kind):
    content = bytearray(damageable[kind].read_bytes())
    for _ in range(data.draw(st.integers(1, 5))):
        content[data.draw(st.integers(8, len(content) - 1))] = data.draw(st.integers(0, 255))
    file = tmp_path_factory.mktemp("damaged") / "session.mcap"
    file.write_bytes(content)
    refusal = ""
    try:
        list(read_bag(file).read_messages())
    except BagError as error:
        refusal = str(error)
    assert not refusal or refusal.startswith(str(file))


def test_messages_compressed_one_by_one(tmp_path):
    write_session(tmp_path / "plain.mcap")
    plain = list(read_bag(tmp_path / "plain.mcap").read_messages())
    with BagWriter(tmp_path / "packed") as packed:
        for topic in ("/a", "/b"):
            packed.add_topic(topic, STRING)
        for message in plain:
            data = zstandard.compress(message.data)
            packed.write_message(message.topic, data, message.log_time, message.publish_time)
    assert list(read_bag(tmp_path / "packed").read_messages()) == plain


def test_messages_recorded_while_simulated_time_stood_are_read_one_by_one(tmp_path):
    with BagWriter(tmp_path / "a.mcap", sidecar=False) as writer:
        writer.add_topic("/note", STRING)
        for number in range(120):
            writer.write_message("/note", bytes(200_000), 10**18, sequence=number)
    bag = read_bag(tmp_path / "a.mcap")
    tracemalloc.start()
    try:
        assert [message.sequence for message in bag.read_messages()] == list(range(120))
        assert tracemalloc.get_traced_memory()[1] < 12 << 20
    finally:
        tracemalloc.stop()


def test_what_does_not_fit_its_type(tmp_path):
    with BagWriter(tmp_path / "bag.mcap") as writer:
        writer.add_topic("/note", STRING)
        writer.write_message("/note", b"\0\1\0\0\xff\xff\0\0hi\0", EPOCH)
        writer.write_message("/note", b"", EPOCH + 1)
    bag = read_bag(tmp_path)
    for message in bag.read_messages():
        with pytest.raises(BagError, match=f"{message.log_time} ns .*{STRING}"):
            bag.deserialize(message)
    with pytest.raises(BagError, match=r"/other; .* /note"):
        next(bag.read_messages(["/other"]))


def test_a_topic_of_two_types_is_refused(tmp_path):
    for k, type_name in enumerate([STRING, "geometry_msgs/msg/PoseStamped"]):
        with BagWriter(tmp_path / f"bag_{k}.mcap", sidecar=False) as bag:
            bag.add_topic("/note", type_name)
    with pytest.raises(BagError, match="one type"):
        read_bag(tmp_path)


@pytest.mark.parametrize("offered", [0, 1])
def test_quality_of_service_that_one_file_of_a_bag_lacks_is_that_of_the_other(tmp_path, offered):
    quality = (DEFAULT_QOS._replace(depth=3),)
    for k in range(2):
        with BagWriter(tmp_path / f"bag_{k}.mcap", sidecar=False) as bag:
            bag.add_topic("/note", STRING, quality if k == offered else ())
            bag.write_message("/note", HI, EPOCH + k)
    assert read_bag(tmp_path).find_topic("/note").qos == quality


def test_messages_of_the_same_time_come_in_the_order_of_the_file(tmp_path):
    with BagWriter(tmp_path / "session.mcap") as bag:
        bag.add_topic("/note", STRING)
        for time, last in ((7, 1), (5, 2), (7, 3)):
            bag.write_message("/note", HI + bytes([last]), EPOCH + time)
            if last == 1:
                bag.flush()  # what follows is in a chunk of its own, which begins earlier
    read = [(m.log_time - EPOCH, m.data[-1]) for m in read_bag(tmp_path).read_messages()]
    assert read == [(5, 2), (7, 1), (7, 3)]


def test_files_of_a_split_bag_are_read_in_their_order_without_metadata(shared_data, tmp_path):
    folder = shared_data / "mcap-rosbag2/rosbag2_py/test/resources/mcap/reindex_test_bags"
    split = read_bag(folder / "multiple_files")
    assert split.message_count == 1324 + 1324 + 529
    for old, new in [(0, 9), (1, 10), (2, 11)]:
        part = folder / f"multiple_files/multiple_files_{old}.mcap"
        shutil.copy(part, tmp_path / f"b_{new}.mcap")
    assert list(read_bag(tmp_path).read_messages()) == list(split.read_messages())


def test_blocks_of_zeros_after_a_power_cut(tmp_path, sessions):
    content = sessions["none"].read_bytes()
    file = tmp_path / "session.mcap"
    file.write_bytes(content[: len(content) // 3] + bytes(5000))
    bag = read_bag(file)
    read = list(bag.read_messages())
    assert bag.fault
    assert 10 < len(read) < 100
    assert read == list(read_bag(sessions["none"]).read_messages())[: len(read)]


def test_an_old_database_and_its_journal(tmp_path):
    live = tmp_path / "live.db3"
    with closing(sqlite3.connect(live)) as database:
        database.executescript(
            "PRAGMA journal_mode = WAL;"
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, "
            "serialization_format TEXT);"
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
            "data BLOB);"
            f"INSERT INTO topics VALUES(1, '/a', '{STRING}', 'cdr'), "
            "(2, '/thing', 'my_msgs/msg/Thing', 'cdr');"
        )
        rows = [(k, 1 + (k == 1), EPOCH + k, HI) for k in range(1, 601) if not 100 <= k <= 126]
        database.executemany("INSERT INTO messages VALUES(?, ?, ?, ?)", rows)
        database.commit()
        for part in ("", "-wal"):  # as a killed recorder leaves them
            shutil.copy(f"{live}{part}", tmp_path / f"killed.db3{part}")
    with pytest.raises(BagError, match="wal_checkpoint"):
        read_bag(tmp_path / "killed.db3")
    bag = read_bag(live)
    thing, note, *others = bag.read_messages()
    assert 2 + len(others) == bag.message_count == 573
    assert bag.deserialize(note).data == "hi"
    with pytest.raises(BagError, match="my_msgs/msg/Thing"):
        bag.deserialize(thing)


@pytest.mark.parametrize(
    ("name", "content", "word"),
    [
        ("missing.mcap", None, "missing.mcap"),
        (".", None, "holds no bag"),
        ("a.mcap", b"\x89MCAP", "MCAP nor SQLite"),
        ("a.mcap", b"#ROSBAG V2.0\n", "is a bag of ROS 1"),
        ("a.mcap", b"hello, world, this is a text", "is not a bag"),
        ("a.mcap.zstd", zstandard.compress(bytes(range(256))), "`zstd -d` unpacks it"),
        ("ros2-jazzy/bags/probe_path_killed", None, "is empty"),
        ("ros2-jazzy/bags/probe_path_sqlite3/probe_path_sqlite3_0.db3", 100_000, "damaged"),
    ],
)
def test_files_that_are_no_bags(shared_data, tmp_path, name, content, word):
    path = shared_data / name if name.startswith("ros2") else tmp_path / name
    if isinstance(content, int):
        content = path.read_bytes()[:content]
        path = tmp_path / "cut.db3"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(BagError, match=word) as caught:
        list(read_bag(path).read_messages())
    assert str(path) in str(caught.value)


def test_a_database_that_is_no_bag(tmp_path):
    with closing(sqlite3.connect(tmp_path / "other.db3")) as database:
        database.execute("CREATE TABLE things(id)")
    with pytest.raises(BagError, match="rosbag2 database"):
        read_bag(tmp_path / "other.db3")
