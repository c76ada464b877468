"""A recording is whole, or broken in one way, which is told in one sentence."""

import re
import struct

import pytest
from rosbags.interfaces import QosDurability
from session_files import EPOCH, PERIOD, TYPES, press, write

from us_sim.command.main import main
from us_sim.recording.reader import read_bag
from us_sim.recording.schemas import serialize_stamped
from us_sim.recording.topic import DEFAULT_QOS
from us_sim.recording.writer import BagWriter
from us_sim.run.session_check import check_bag

IMAGE = "/ultrasound/image"


def findings(file):
    found = check_bag(read_bag(file))
    return found, [(each.kind, each.text) for each in found.findings]


def of(messages, topic):
    return [message for message in messages if message[0] == topic]


def test_a_whole_session_passes_with_its_numbers(tmp_path, capsys):
    file = write(tmp_path / "s.mcap", press())
    found, told = findings(file)
    assert told == []
    (head, *rows), by_name = found.rows, {}
    for row in rows:
        by_name[row[0]] = dict(zip(head, row, strict=True))
    expected = ("120", "60.0", "0.02", "4.00", "4.00", "4.00", "0", "0")
    assert by_name[IMAGE] == dict(zip(head, (IMAGE, *expected), strict=True))
    assert main(["bag", "check", str(file)]) == 0
    assert "nothing is wrong with it" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["mcap", "chunkzstd", "sqlite3"])
def test_bags_of_the_real_rosbag2_pass(shared_data, name):
    found, told = findings(shared_data / f"ros2-jazzy/bags/probe_path_{name}")
    assert told == []
    rates = {row[0]: row[2] for row in found.rows}
    assert abs(float(rates["/tracker/pose"]) - 60) < 0.2


def test_the_bags_of_rosbag2s_own_tests_pass(shared_data):
    files = [*shared_data.glob("mcap-rosbag2/rosbag2_[pt]*/**/metadata.yaml")]
    assert len(files) > 8
    for file in files:
        assert findings(file.parent)[1] == [], file.parent


def test_stamps_are_those_that_rosbags_decodes(shared_data):
    bag = read_bag(shared_data / "ros2-jazzy/bags/probe_path_mcap")
    seen = set()
    for message in bag.read_messages():
        topic = bag.find_topic(message.topic)
        reader = bag.make_stamp_reader(topic)
        decoded = bag.deserialize(message)
        header = getattr(decoded, "header", None) or (
            decoded.transforms[0].header if topic.name == "/tf" else None
        )
        if header is None:
            assert reader is None
            continue
        assert reader(message.data) == header.stamp.sec * 10**9 + header.stamp.nanosec
        seen.add(topic.type_name)
    assert len(seen) == 5


def test_a_big_endian_stamp_is_read(tmp_path):
    bag = read_bag(write(tmp_path / "s.mcap", press(1)))
    reader = bag.make_stamp_reader(bag.find_topic("/probe/pose"))
    assert reader(b"\0\0\0\0" + struct.pack(">iI", 7, 5)) == 7 * 10**9 + 5


def remove(topic, part):
    return lambda messages: [messages.remove(each) for each in of(messages, topic)[part]]


def exchange(field):
    """A change: two images have one another's field."""

    def change(messages):
        one, other = of(messages, IMAGE)[40:42]
        one[field], other[field] = other[field], one[field]

    return change


def later(seconds, *fields, topic="", after=0):
    """A change: log time (2) or time of sending (3) of messages is later."""

    def change(messages):
        for message in messages:
            if message[4] > after and message[0].startswith(topic):
                for field in fields:
                    message[field] += round(1e9 * seconds)

    return change


def restamp(message, stamp):
    message[1] = message[1][:4] + struct.pack("<iI", *divmod(stamp, 10**9)) + message[1][12:]


def pause(messages):
    later(0.8, 2, 3, after=60)(messages)
    for message in messages:
        restamp(message, EPOCH + (message[4] - 1) * PERIOD + 800_000_000 * (message[4] > 60))


def shorten(messages):
    of(messages, "/probe/pose")[20][1] = b"\0\1\0\0\1"


@pytest.mark.parametrize(
    ("change", "kinds", "told"),
    [
        (remove("/probe/wrench", slice(30, 37)), "loss", "lacks 7 messages"),
        (remove(IMAGE, slice(60, None)), "gap", "longest of 0.997 s at 0.986 s, while poses"),
        (remove(IMAGE, slice(None)), "gap", "1 gap, .* while poses came"),
        (list.clear, "index", "holds no message"),
        (pause, "gap", "/probe/pose has 1 gap, the longest of 0.817 s at 0.983 s"),
        (
            lambda m: restamp(of(m, "/tissue/nodes")[50], EPOCH + 50 * PERIOD + 1),
            "stamp",
            "/tissue/nodes has 1 message .* without",
        ),
        (shorten, "order stamp stamp stamp", "/probe/pose has 1 message that came too short"),
        (exchange(4), "order", f"{IMAGE} has 1 message .* numbers, first at 0.686 s"),
        (exchange(1), "order latency", f"{IMAGE} has 1 message that went back in their stamps"),
        (later(0.05, 3, topic=IMAGE), "latency", "came up to 49.7 ms before being sent"),
        (later(0.7, 2, 3, topic=IMAGE), "latency", "120 messages .* 0.5 s old"),
    ],
)
def test_what_is_wrong_with_messages_is_told(tmp_path, change, kinds, told):
    messages = press()
    change(messages)
    file = write(tmp_path / "s.mcap", sorted(messages, key=lambda message: message[2]))
    assert main(["bag", "check", str(file)]) == 1
    found = findings(file)[1]
    assert [kind for kind, _ in found] == kinds.split()
    assert re.search(told, found[0][1])


def number_together(messages):
    for number, message in enumerate(messages):
        message[4] = number


def number_anew(messages):
    for message in messages:
        message[4] -= 60 * (message[4] > 60)


@pytest.mark.parametrize(
    ("change", "latency", "missing"),
    [
        (later(86_400, 2, 3), "-", 0),
        (later(86_400, 3), "-", 0),
        (number_together, "1.00", None),
        (number_anew, "1.00", 0),
    ],
)
def test_what_is_only_unusual_is_whole(tmp_path, change, latency, missing):
    messages = press()
    change(messages)
    found = check_bag(read_bag(write(tmp_path / "s.mcap", messages)))
    assert not found.findings
    assert found.rows[1][2:5] == ("60.0", "0.02", latency)
    assert {each.missing for each in found.topics} == {missing}


def cut_in_half(content, _):
    del content[len(content) // 2 :]


def damage_a_chunk(content, _):
    content[len(content) // 3] ^= 1


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (cut_in_half, "was not ended properly.*`mcap recover`"),
        (damage_a_chunk, "checksum"),
    ],
)
def test_what_is_wrong_with_a_file_is_told(tmp_path, change, told):
    file = write(tmp_path / "s.mcap", press())
    content = bytearray(file.read_bytes())
    change(content, file)
    file.write_bytes(content)
    (kind, text), *others = findings(file)[1]
    assert kind == "index"
    assert re.search(told, text)
    assert not others


@pytest.mark.parametrize(
    ("stamps", "logged", "is_told"),  # s
    [
        ([0.0, 20.0, 19.2], [0.0, 20.0, 19.2], False),
        ([0.0, 20.0, 12.0], [0.0, 20.0, 20.1], False),
        ([0.0, 20.0, 5.0], [0.0, 20.0, 20.1], True),
    ],
)
def test_what_several_publish_may_come_in_another_order(tmp_path, stamps, logged, is_told):
    kind = "diagnostic_msgs/msg/DiagnosticArray"
    with BagWriter(tmp_path / "several.mcap", sidecar=False) as bag:
        bag.add_topic("/diagnostics", kind)
        for number, (stamp, seconds) in enumerate(zip(stamps, logged, strict=True), 1):
            came = EPOCH + round(1e9 * seconds)
            report = serialize_stamped(kind, EPOCH + round(1e9 * stamp), "", status=[])
            bag.write_message("/diagnostics", bytes(report), came, came, number)
    assert bool(findings(tmp_path / "several.mcap")[1]) == is_told


def test_a_folder_that_lacks_a_file_of_its_metadata(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        for topic, kind in TYPES.items():
            bag.add_topic(topic, kind)
        for topic, data, *times, number in press():
            bag.write_message(topic, data, *times, number)
    yaml = tmp_path / "bag" / "metadata.yaml"
    yaml.write_text(yaml.read_text().replace("- bag_0.mcap\n", "- bag_0.mcap\n  - bag_1.mcap\n"))
    ((kind, text),) = findings(tmp_path / "bag")[1]
    assert kind == "index"
    assert "names files that are not there: bag_1.mcap" in text


def test_latched_messages_have_no_age_and_no_rate(tmp_path):
    latched = DEFAULT_QOS._replace(durability=QosDurability.TRANSIENT_LOCAL, depth=1)
    with BagWriter(tmp_path / "s.mcap", sidecar=False) as bag:
        for topic, kind in TYPES.items():
            bag.add_topic(topic, kind, [latched])
        for topic, data, *times, number in press()[::40]:
            bag.write_message(topic, data, *(time + 10**10 for time in times), number)
    found = check_bag(read_bag(tmp_path / "s.mcap"))
    assert {row[4] for row in found.rows[1:]} == {"-"}
