"""A bag written from a thread of its own: nobody waits, and nothing is lost unsaid."""

import resource
import threading
import time

import pytest
from session_files import EPOCH, STRING

from us_sim.errors import BagError
from us_sim.recording.reader import read_bag
from us_sim.recording.write_behind import WriteBehind
from us_sim.recording.writer import BagWriter


def wait_until(condition, seconds=20):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.fixture
def slow_disk(monkeypatch):
    """An event before which nothing is written."""
    may_write = threading.Event()
    write = BagWriter.write_message

    def when_allowed(self, *arguments):
        may_write.wait(30)
        write(self, *arguments)

    monkeypatch.setattr(BagWriter, "write_message", when_allowed)
    yield may_write
    may_write.set()


def test_nobody_waits_for_the_disk_and_what_is_too_much_is_counted(tmp_path, slow_disk):
    bag = WriteBehind(BagWriter(tmp_path / "session.mcap"), max_cache_size=10_000)
    for topic in ("/a", "/b"):
        bag.add_topic(topic, STRING)
    began = time.monotonic()
    taken = [bag.put_message("/ab"[:1] + "ab"[k % 2], bytes(100), EPOCH + k) for k in range(300)]
    assert time.monotonic() - began < 5  # the disk takes nothing for 30 s
    assert taken == [True] * 100 + [False] * 200
    slow_disk.set()
    bag.close()
    read = read_bag(tmp_path / "session.mcap")
    assert [m.log_time - EPOCH for m in read.read_messages()] == list(range(100))
    assert read.count_losses() == {"/a": 100, "/b": 100}


def test_numbers_show_where_messages_are_missing(tmp_path, slow_disk):
    from mcap.reader import make_reader

    bag = WriteBehind(BagWriter(tmp_path / "session.mcap"), max_cache_size=300)
    bag.add_topic("/a", STRING)
    assert [bag.put_message("/a", bytes(100), EPOCH + k) for k in range(5)] == [True] * 3 + [
        False
    ] * 2
    slow_disk.set()
    wait_until(lambda: bag.put_message("/a", bytes(250), EPOCH + 9))
    bag.close()
    with (tmp_path / "session.mcap").open("rb") as file:
        numbers = [m.sequence for _, _, m in make_reader(file).iter_messages()]
    lost = bag.losses.total()
    assert numbers == [1, 2, 3, 4 + lost]


def test_a_full_disk_is_written_to_again_when_there_is_room(tmp_path, monkeypatch):
    monkeypatch.setattr("us_sim.recording.write_behind._RETRY", 0.05)
    file = tmp_path / "session.mcap"
    bag = WriteBehind(BagWriter(file, chunk_size=1000), max_cache_size=20_000)
    bag.add_topic("/a", STRING)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, hard))
    try:
        for k in range(100):
            while not bag.problem and not bag.put_message("/a", bytes(1000), EPOCH + k):
                time.sleep(0.01)
        wait_until(lambda: "File too large" in bag.problem)
        assert "File too large" in bag.untold.popleft()
        assert 30 < read_bag(file).message_count < 60  # as far as it goes
        taken = [bag.put_message("/a", bytes(1000), EPOCH + 200 + k) for k in range(100)]
        assert 0 < sum(taken) < 100
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    wait_until(lambda: not bag.problem)
    bag.put_message("/a", bytes(1000), EPOCH + 1000)
    bag.close()
    whole = read_bag(tmp_path)
    assert not whole.fault
    times = [message.log_time - EPOCH for message in whole.read_messages()]
    assert times[-1] == 1000
    assert whole.count_losses() == bag.losses
    assert set(range(200)) & set(times) >= set(range(40))


def test_a_failure_of_any_kind_is_counted_and_ends_nothing(tmp_path):
    bag = WriteBehind(BagWriter(tmp_path / "session.mcap"), 10**6)
    bag.add_topic("/a", STRING)
    bag.put_message("/a", b"good", EPOCH)
    bag.put_message("/a", b"no time", -1)
    bag.put_message("/a", b"good", EPOCH + 1)
    bag.close()
    assert read_bag(tmp_path).message_count == 2
    assert read_bag(tmp_path).count_losses() == {"/a": 1}


def test_without_a_queue_whoever_puts_waits_and_nothing_is_lost(tmp_path, slow_disk):
    bag = WriteBehind(BagWriter(tmp_path / "session.mcap"), max_cache_size=0)
    bag.add_topic("/a", STRING)
    with pytest.raises(BagError, match="my_msgs/msg/Unheard is unknown"):
        bag.add_topic("/b", "my_msgs/msg/Unheard")
    threading.Timer(0.2, slow_disk.set).start()
    assert all(bag.put_message("/a", bytes(100_000), EPOCH + k) for k in range(30))
    bag.close()
    assert read_bag(tmp_path).message_count == 30
    assert not [thread for thread in threading.enumerate() if thread.name == "bag writer"]
