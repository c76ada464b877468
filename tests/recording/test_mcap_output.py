"""One MCAP file on a disk that fills up: whole records and an index at every moment."""

import errno

from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from us_sim.recording.mcap_output import McapOutput
from us_sim.recording.reader import read_bag


class Disk:
    """A file on a disk that has room for so many bytes; a write may end in the middle."""

    def __init__(self, file, room):
        self._file, self.room = file, room

    def write(self, data):
        if self._file.tell() >= self.room:
            raise OSError(errno.ENOSPC, "No space left on device")
        return self._file.write(data[: max(1, min(len(data), self.room - self._file.tell()))])

    def __getattr__(self, name):
        return getattr(self._file, name)


def read(path):
    """Messages, attachments and metadata by the mcap package, checksums and index checked."""
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        statistics = reader.get_summary().statistics
        messages = [(c.topic, m.log_time, m.sequence, m.data) for _, c, m in reader.iter_messages()]
        assert statistics.message_count == len(messages)
        times = [message[1] for message in messages]
        assert statistics.message_start_time == min(times, default=0)
        assert statistics.message_end_time == max(times, default=0)
        attached = [each.data for each in reader.iter_attachments()]
        notes = [each.metadata for each in reader.iter_metadata()]
    return messages, attached, notes


def output_at(path, compression="", chunk_size=300):
    output = McapOutput(path, "test", compression=compression, chunk_size=chunk_size)
    for topic in ("/a", "/b"):
        output.add_topic(topic, "std_msgs/msg/String", "string data\n", {"key": topic})
    return output


@settings(max_examples=40, deadline=None)
@given(
    room=st.integers(900, 6000) | st.just(10**6),
    room_again=st.integers(0, 3000),
    sizes=st.lists(st.integers(0, 500), min_size=1, max_size=30),
    compression=st.sampled_from(["", "zstd"]),
)
def test_what_fits_is_kept_whole_with_an_index(
    tmp_path_factory, room, room_again, sizes, compression
):
    file = tmp_path_factory.mktemp("disk") / "session.mcap"
    output = output_at(file, compression)
    disk = output._file = Disk(output._file, room)
    sent, failures = {"/a": [], "/b": []}, 0
    for k, size in enumerate(sizes):
        topic = "/a" if k % 3 else "/b"
        data = bytes([k]) * size
        sent[topic].append((topic, 1000 + k, k, data))
        try:
            output.add_message(topic, 1000 + k, 0, k, data)
            if k == 5:
                output.add_attachment("scene.yaml", "text/plain", b"name: arm", 7)
                output.add_metadata("marker", {"text": "in"})
        except OSError:
            failures += 1
            disk.room = room + room_again  # somebody has tidied up
    output.finish()
    messages, attached, notes = read(file)
    assert len(messages) == output.message_count
    assert output.message_count + output.dropped.total() == len(sizes)
    everything = sent["/a"] + sent["/b"]
    assert all(message in everything for message in messages)
    assert attached in ([], [b"name: arm"])
    assert notes in ([], [{"text": "in"}])
    if room == 10**6:
        assert not failures
        assert sorted(messages) == sorted(everything)


def test_the_last_chunks_make_room_for_the_index(tmp_path):
    output = output_at(tmp_path / "session.mcap", chunk_size=1)
    for k in range(40):
        output.add_message("/a", k, k, k, b"x" * 100)
    size = (tmp_path / "session.mcap").stat().st_size
    output._file = Disk(output._file, size)  # full to the last byte
    output.finish()
    messages, _, _ = read(tmp_path / "session.mcap")
    assert [message[1] for message in messages] == list(range(len(messages)))
    assert 20 < len(messages) < 40
    assert output.dropped == {"/a": 40 - len(messages)}
    assert (output.start, output.end) == (0, len(messages) - 1)


def test_a_channel_is_declared_again_when_its_chunk_was_dropped(tmp_path):
    output = output_at(tmp_path / "session.mcap", chunk_size=10**6)
    disk = output._file = Disk(output._file, 0)
    output.add_message("/a", 1, 1, 1, b"lost")
    try:
        output.end_chunk()
    except OSError:
        disk.room = 10**6
    output.add_message("/a", 2, 2, 2, b"kept")
    output.end_chunk()
    cut = read_bag(tmp_path / "session.mcap")  # no index yet, so its records must tell all
    assert [(m.topic, m.data) for m in cut.messages()] == [("/a", b"kept")]
