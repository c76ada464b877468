"""A recording whose file somebody removes or moves is not lost in silence, and goes on."""

import shutil

import pytest

from us_sim.errors import BagError
from us_sim.recording.reader import read_bag
from us_sim.recording.writer import BagWriter

EPOCH = 1_700_000_000_000_000_000
HI = bytes.fromhex("00010000 03000000 686900")


@pytest.fixture
def bag(tmp_path):
    """Of one message, which the operating system has."""
    bag = BagWriter(tmp_path / "here" / "session.mcap")
    bag.add_topic("/note", "std_msgs/msg/String")
    bag.write("/note", HI, EPOCH)
    bag.flush()
    return bag


def test_a_file_that_was_removed_is_said_to_be_lost(bag, tmp_path):
    bag.path.unlink()
    bag.write("/note", HI, EPOCH + 1)
    with pytest.raises(BagError, match=r"session.mcap was removed .* 2 messages are lost with"):
        bag.flush()
    assert bag.lost == {"/note": 2}
    bag.flush()  # it is said once
    bag.write("/note", HI, EPOCH + 2)
    bag.close()
    further = read_bag(tmp_path / "here" / "session_1.mcap")
    assert (further.complete, further.message_count, bag.message_count) == (True, 1, 1)
    assert read_bag(tmp_path / "here").message_count == 1  # metadata.yaml speaks of what is there


def test_a_file_that_was_moved_is_complete_where_it_is(bag, tmp_path):
    bag.path.rename(tmp_path / "kept.mcap")
    bag.write("/note", HI, EPOCH + 1)
    with pytest.raises(BagError, match=r"was moved away .* 2 messages; .* goes on in .*_1.mcap"):
        bag.split()
    assert read_bag(tmp_path / "kept.mcap").complete
    assert read_bag(tmp_path / "kept.mcap").message_count == 2
    assert not bag.lost
    bag.close()


def test_a_folder_that_was_removed_is_made_again(bag, tmp_path):
    shutil.rmtree(tmp_path / "here")
    with pytest.raises(BagError, match="was removed"):
        bag.flush()
    bag.write("/note", HI, EPOCH + 1)
    bag.close()
    assert read_bag(tmp_path / "here").message_count == 1


def test_where_nothing_can_go_on_it_waits_until_it_can(bag, tmp_path):
    shutil.rmtree(tmp_path / "here")
    (tmp_path / "here").touch()
    with pytest.raises(BagError, match=r"here cannot be written .* 1 message is lost"):
        bag.flush()
    assert not bag.resume()
    (tmp_path / "here").unlink()
    assert bag.resume()
    bag.write("/note", HI, EPOCH + 1)
    bag.close()
    assert read_bag(tmp_path / "here").message_count == 1


@pytest.mark.parametrize("whole_folder", [False, True])
def test_what_was_removed_before_the_end_is_said_at_the_end(bag, whole_folder):
    shutil.rmtree(bag.path.parent) if whole_folder else bag.path.unlink()
    with pytest.raises(BagError, match="1 message is lost with it"):
        bag.close()
    assert bag.lost == {"/note": 1}
    bag.close()


@pytest.mark.parametrize("part", [0.0, 0.01, 0.2, 0.5, 0.9, 0.999])
@pytest.mark.parametrize("ends", [True, False])
def test_a_file_that_was_cut_keeps_what_is_left_and_the_rest_is_said(tmp_path, part, ends):
    bag = BagWriter(tmp_path / "session.mcap", chunk_size=300)
    bag.attach("scene.yaml", "text/yaml", b"name: arm", EPOCH)
    for topic in ("/note", "/other"):
        bag.add_topic(topic, "std_msgs/msg/String")
    for k in range(100):
        bag.write("/note", HI, EPOCH + k)
    bag.flush()
    size = bag.path.stat().st_size
    with bag.path.open("r+b") as file:
        file.truncate(int(part * size))
    for k in range(100, 120):
        bag.write("/other", HI, EPOCH + k)
        bag.write("/note", HI, EPOCH + k)
    with pytest.raises(BagError, match="was cut by another process"):
        (bag.close if ends else bag.flush)()
    if not ends:
        bag.write("/note", HI, EPOCH + 200)
        bag.close()
    whole = [read_bag(each) for each in sorted(tmp_path.glob("*.mcap"))]
    assert len(whole) == (1 if ends else 2)
    assert [each.faults() for each in whole] == [[]] * len(whole)
    assert [*whole[-1].attachments()] == ["scene.yaml"] or ends
    kept = sum(each.message_count for each in whole)
    assert kept + bag.lost.total() == (140 if ends else 141)
    assert bag.lost["/note"] > 0
    assert kept >= 40 + 90 * (part > 0.99)
