"""The recorder: the same bags as the real rosbag2, and nothing lost in silence."""

import errno
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from mcap.reader import make_reader
from mcap.records import Metadata
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability, QosReliability
from rosbags.rosbag2 import Reader
from session_files import EPOCH, HI, STRING, text

from us_sim.errors import BagError
from us_sim.recording.reader import read_bag
from us_sim.recording.topic import DEFAULT_QOS
from us_sim.recording.writer import BagWriter

WEAK = DEFAULT_QOS._replace(reliability=QosReliability.BEST_EFFORT)


def write_all(bag, messages):
    for message in messages:
        topic, _, *times, data, number = message
        bag.write_message(topic, data, *times, number)


def mcap_content(file):
    """Header, channels, schemas and rosbag2 metadata records of an MCAP file."""
    with file.open("rb") as stream:
        reader = make_reader(stream)
        header, summary = reader.get_header(), reader.get_summary()
    with file.open("rb") as stream:
        records = [
            (r.name, {name: yaml.safe_load(text) for name, text in r.metadata.items()})
            for r in StreamReader(stream).records
            if isinstance(r, Metadata)
        ]
    channels = {
        c.topic: (c.message_encoding, c.metadata, summary.schemas[c.schema_id].name)
        for c in summary.channels.values()
    }
    schemas = {s.name: (s.encoding, s.data) for s in summary.schemas.values()}
    return header, channels, schemas, records


@pytest.mark.parametrize("name", ["probe_path_mcap", "probe_path_chunkzstd"])
def test_a_real_bag_written_again_is_the_same_bag(shared_data, tmp_path, name):
    folder = shared_data / "ros2-jazzy/bags" / name
    real = read_bag(folder)
    document = yaml.safe_load((folder / "metadata.yaml").read_text())
    listed = document["rosbag2_bagfile_information"]["topics_with_message_count"]
    with BagWriter(tmp_path / name) as ours:
        for entry in (real.find_topic(each["topic_metadata"]["name"]) for each in listed):
            ours.add_topic(entry.name, entry.type_name, entry.qos, schema=entry.schema)
        write_all(ours, real.read_messages())
    file = tmp_path / name / f"{name}_0.mcap"
    real_header, *expected = mcap_content(folder / file.name)
    header, *written = mcap_content(file)
    assert header.profile == real_header.profile == "ros2"
    assert written == expected
    sidecars = [
        yaml.safe_load((each / "metadata.yaml").read_text()) for each in (file.parent, folder)
    ]
    assert sidecars[0] == sidecars[1]
    assert list(read_bag(file).read_messages()) == list(real.read_messages())


@pytest.mark.parametrize("compression", ["none", "zstd"])
def test_rosbags_and_mcap_read_what_was_written(tmp_path, compression):
    file = tmp_path / "session.mcap"
    latched = DEFAULT_QOS._replace(depth=1, durability=QosDurability.TRANSIENT_LOCAL)
    with BagWriter(file, compression=compression, chunk_size=400) as bag:
        bag.add_topic("/a", STRING, [DEFAULT_QOS])
        bag.add_topic("/b", STRING, [latched, WEAK])
        bag.add_topic("/silent", "geometry_msgs/msg/PoseStamped")
        for k in range(300):
            topic = "/a" if k % 3 else "/b"
            bag.write_message(topic, text(f"{k}"), EPOCH + k * 10**8, EPOCH + k)
    with AnyReader([tmp_path]) as reader:
        assert reader.message_count == 300
        counts = {connection.topic: connection.msgcount for connection in reader.connections}
        assert counts == {"/a": 200, "/b": 100, "/silent": 0}
        contents = [
            reader.deserialize(data, connection.msgtype).data
            for connection, _, data in reader.messages()
        ]
    assert contents == [f"{k}" for k in range(300)]
    with Reader(file) as reader:
        assert (reader.start_time, reader.end_time) == (EPOCH, EPOCH + 299 * 10**8 + 1)
        (b,) = (c for c in reader.connections if c.topic == "/b")
        assert [int(profile.depth) for profile in b.ext.offered_qos_profiles] == [1, 10]
    with file.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_summary().statistics.chunk_count > 30
        times = [(m.log_time, m.publish_time) for _, _, m in reader.iter_messages()]
    assert times == [(EPOCH + k * 10**8, EPOCH + k) for k in range(300)]


def test_flush_makes_everything_readable_before_the_bag_is_closed(tmp_path):
    bag = BagWriter(tmp_path / "session.mcap")
    bag.add_topic("/note", STRING)
    bag.write_message("/note", HI, EPOCH)
    assert read_bag(tmp_path / "session.mcap").message_count == 0
    bag.flush()
    half = read_bag(tmp_path / "session.mcap")
    assert [half.deserialize(message).data for message in half.read_messages()] == ["hi"]
    bag.close()
    assert not read_bag(tmp_path).fault


@pytest.mark.parametrize("name", ["session.mcap", "bag"])
def test_metadata_that_cannot_be_written_is_said(tmp_path, name):
    folder = tmp_path / "bag"
    bag = BagWriter(tmp_path / "bag" / name if name.endswith(".mcap") else folder)
    bag.add_topic("/note", STRING)
    bag.write_message("/note", HI, EPOCH)
    (folder / "metadata.yaml").mkdir()
    with pytest.raises(BagError, match=f"`ros2 bag reindex {folder}`"):
        bag.close()
    assert read_bag(folder).message_count == 1


class Disk:
    """A file on a disk that has room for so many bytes; a write may end in the middle."""

    def __init__(self, file, room):
        self._file, self.room = file, room

    def write(self, data):
        if self._file.tell() >= self.room:
            raise OSError(errno.ENOSPC, "No space left on device")
        return self._file.write(data[: self.room - self._file.tell()])

    def __getattr__(self, name):
        return getattr(self._file, name)


def disk_under(bag, room):
    bag._file._stream = Disk(bag._file._stream, room)
    return bag._file._stream


def note_until_full(bag):
    bag.add_topic("/note", STRING)
    for k in count():
        try:
            bag.write_message("/note", text(f"{k}" + 100 * "x"), EPOCH + k)
        except BagError:
            return k
    return None


@pytest.mark.parametrize("compression", ["none", "zstd"])
@pytest.mark.parametrize("room", [3000, 4444])
def test_what_a_full_disk_did_not_take_is_written_when_there_is_room(tmp_path, compression, room):
    file = tmp_path / "session.mcap"
    bag = BagWriter(file, chunk_size=300, compression=compression)
    disk = disk_under(bag, room)
    written = note_until_full(bag)
    for _ in range(3):
        with pytest.raises(BagError, match="No space left"):
            bag.flush()
    there = read_bag(file).message_count
    assert 0 < there <= written
    assert "can be read" in bag.problem
    disk.room = 10**6
    bag.flush()
    assert not bag.problem
    bag.close()
    with file.open("rb") as stream:
        messages = [*make_reader(stream, validate_crcs=True).iter_messages()]
    assert [m.log_time - EPOCH for _, _, m in messages] == list(range(written))
    with AnyReader([tmp_path]) as reader:
        assert reader.message_count == written


@pytest.mark.parametrize("room", [3000, 3300, 3500])
@pytest.mark.parametrize("reserve", [0, 100_000])
def test_a_disk_that_stays_full_costs_nothing_where_there_is_a_reserve(tmp_path, room, reserve):
    bag = BagWriter(tmp_path / "session.mcap", chunk_size=300)
    disk = disk_under(bag, room)
    kept_free = bag._file._reserve
    bag._file._reserve = SimpleNamespace(close=lambda: setattr(disk, "room", room + reserve))
    written = note_until_full(bag)
    if reserve:
        bag.close()
        assert not read_bag(tmp_path).fault
        assert read_bag(tmp_path).message_count == written
    else:
        with pytest.raises(BagError, match=r"No space left.*index.*`mcap recover`"):
            bag.close()
        assert 0 < read_bag(tmp_path).message_count < written
    kept_free.close()


def test_an_empty_bag_is_a_bag(tmp_path):
    with BagWriter(tmp_path / "quiet") as bag:
        bag.add_topic("/note", STRING)
    read = read_bag(tmp_path / "quiet")
    assert not read.fault
    assert (read.start, read.end, list(read.read_messages())) == (None, None, [])
    assert [topic.name for topic in read.topics] == ["/note"]
    with AnyReader([tmp_path / "quiet"]) as reader:
        assert reader.message_count == 0


def test_nothing_is_overwritten(tmp_path):
    with BagWriter(tmp_path / "first.mcap"):
        pass
    with pytest.raises(BagError, match=r"first.mcap"):
        BagWriter(tmp_path / "first.mcap")
    with pytest.raises(BagError, match=r"second/second.mcap"):
        BagWriter(tmp_path / "second.mcap")
    for folder in (tmp_path, "/", ""):
        with pytest.raises(BagError, match="not empty"):
            BagWriter(folder)
    with BagWriter(tmp_path / "second/second.mcap"):
        pass
    assert len(list(tmp_path.iterdir())) == 3


def test_a_further_file_is_the_next_that_is_free(tmp_path):
    for expected in ("a.mcap", "a_1.mcap", "a_2.mcap"):
        with BagWriter(tmp_path / "a.mcap", further=True) as bag:
            assert bag.path == tmp_path / expected
            bag.add_topic("/note", STRING)
    with BagWriter(tmp_path / "folder"):
        pass
    with BagWriter(tmp_path / "folder", further=True) as bag:
        assert bag.path == tmp_path / "folder/folder_1.mcap"


def offered(folder):
    """Depth and reliability of each profile of the first topic, by metadata.yaml."""
    document = yaml.safe_load((folder / "metadata.yaml").read_text())
    first = document["rosbag2_bagfile_information"]["topics_with_message_count"][0]
    profiles = first["topic_metadata"]["offered_qos_profiles"]
    return [(each["depth"], each["reliability"]) for each in profiles]


def test_a_topic_may_be_added_again_but_not_change_its_type(tmp_path):
    with BagWriter(tmp_path / "bag.mcap") as bag:
        bag.add_topic("/note", STRING, [DEFAULT_QOS])
        bag.add_topic("/note", STRING, [DEFAULT_QOS, WEAK])
        with pytest.raises(BagError, match=STRING):
            bag.add_topic("/note", "geometry_msgs/msg/PoseStamped")
    # Quality of service that is offered later is in the metadata, too.
    assert offered(tmp_path) == [(10, "reliable"), (10, "best_effort")]


@pytest.mark.parametrize("take_away", [Path.unlink, lambda file: file.rename(file.with_name("k"))])
def test_a_file_that_was_taken_away_is_said(tmp_path, take_away):
    bag = BagWriter(tmp_path / "session.mcap")
    take_away(bag.path)
    with pytest.raises(BagError, match="moved"):
        bag.close()


@pytest.mark.parametrize("place", ["file/session.mcap", "a\0b.mcap"])
def test_places_that_cannot_be_written(tmp_path, place):
    (tmp_path / "file").touch()
    with pytest.raises(BagError, match="be made"):
        BagWriter(tmp_path / place)


@pytest.mark.parametrize(
    ("call", "word"),
    [
        (lambda bag: bag.add_topic("", STRING), "topic name"),
        (lambda bag: bag.add_topic("/thing", "my_msgs/msg/Unheard"), "my_msgs/msg/Unheard"),
        (lambda bag: bag.write_message("/other", HI, EPOCH), "/other"),
        (lambda bag: (bag.close(), bag.close(), bag.write_message("/note", HI, EPOCH)), "closed"),
    ],
)
def test_misuse(tmp_path, call, word):
    with BagWriter(tmp_path / "bag.mcap") as bag:
        bag.add_topic("/note", STRING)
        with pytest.raises(BagError, match=word):
            call(bag)
