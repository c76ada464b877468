"""Schema texts and type hashes, against what the real rosbag2 wrote."""

import json
import re

import pytest
from mcap.reader import make_reader

from us_sim.errors import BagError
from us_sim.recording.schemas import (
    compute_type_hash,
    make_schema,
    normalize_type,
    parse_definitions,
)

RULE = "=" * 80


@pytest.fixture(scope="module")
def real_bag(shared_data):
    """Schema texts and type hashes by type name, of the real recorder."""
    with (shared_data / "ros2-jazzy/bags/probe_path_mcap/probe_path_mcap_0.mcap").open("rb") as f:
        summary = make_reader(f).get_summary()
    texts = {schema.name: schema.data.decode() for schema in summary.schemas.values()}
    hashes = {
        summary.schemas[channel.schema_id].name: channel.metadata["topic_type_hash"]
        for channel in summary.channels.values()
    }
    return texts, hashes


@pytest.fixture
def _no_ros(monkeypatch):
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)


def parts(text, type_name):
    """Text of each message in a schema, by its full name, in order."""
    first, *others = re.split(rf"\n{RULE}\nMSG: (\S+)\n", text)
    names = [type_name, *map(normalize_type, others[::2])]
    return dict(zip(names, [first, *others[1::2]], strict=True))


def fields(text, package):
    """The definitions of a message text: (type, name, constant) of each line."""
    lines = (re.sub(r"\s*#.*", "", line).strip() for line in text.splitlines())
    found = []
    for line in filter(None, lines):
        kind, rest = line.split(None, 1)
        bare = re.match(r"[\w/]+", kind)[0]
        if bare[0].isupper():
            kind = f"{package}/{kind}"
        if "=" in rest:
            name, value = (part.strip() for part in rest.split("=", 1))
        else:
            name, value = rest.split()[0], ""  # rosbags keeps no defaults
        found.append((kind, name, value))
    return sorted(found, key=lambda field: bool(field[2]))


@pytest.mark.usefixtures("_no_ros")
def test_without_ros_the_definitions_are_those_of_the_real_recorder(real_bag):
    texts, _ = real_bag
    assert len(texts) == 6
    for type_name, text in texts.items():
        real, ours = parts(text, type_name), parts(make_schema(type_name), type_name)
        assert {*ours} == {*real}
        for name, definition in real.items():
            package = name.split("/")[0]
            assert fields(ours[name], package) == fields(definition, package), name


@pytest.mark.usefixtures("_no_ros")
def test_hashes_are_those_of_the_real_recorder(real_bag):
    _, hashes = real_bag
    assert {name: compute_type_hash(name) for name in hashes} == hashes


def test_an_overlay_hides_what_it_overrides(tmp_path, monkeypatch):
    for prefix, text in [("under", "int32 old\n"), ("over", "int32 new\nOther[<=3] others\n")]:
        folder = tmp_path / prefix / "share/my_msgs/msg"
        folder.mkdir(parents=True)
        (folder / "Thing.msg").write_text(text)
        (folder / "Other.msg").write_text("# note\nstring<=5 name\nint32 MAX=5\n")
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"{tmp_path}/over:{tmp_path}/under")
    thing, other = parts(make_schema("my_msgs/msg/Thing"), "my_msgs/msg/Thing").values()
    assert fields(thing, "my_msgs") == [
        ("int32", "new", ""),
        ("my_msgs/Other[<=3]", "others", ""),
    ]
    assert fields(other, "my_msgs") == [("string<=5", "name", ""), ("int32", "MAX", "5")]
    assert compute_type_hash("my_msgs/msg/Thing").startswith("RIHS01_")


@pytest.mark.usefixtures("_no_ros")
def test_every_message_of_the_graph_can_be_written(shared_data):
    samples = json.loads((shared_data / "ros2-jazzy/messages.json").read_text())
    for sample in samples:
        if "/msg/" not in (type_name := sample["type"]):
            continue
        store = parse_definitions(type_name, make_schema(type_name))
        message = store.deserialize_cdr(bytes.fromhex(sample["cdr_hex"]), type_name)
        again = store.serialize_cdr(message, type_name, little_endian=True)
        assert bytes(again).hex().startswith(sample["cdr_hex"].rstrip("0"))


@pytest.mark.usefixtures("_no_ros")
@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "my_msgs/msg/Unheard",
            "my_msgs/msg/Unheard is unknown: install the ROS 2 package my_msgs",
        ),
        ("String", "'String' is not a message type"),
        ("../../etc/msg/passwd", "is not a message type"),
    ],
)
def test_unknown_types(name, message):
    with pytest.raises(BagError, match=message):
        make_schema(name)


@pytest.mark.parametrize("text", ["int32", "wibble wobble wubble"])
def test_text_that_defines_nothing(text):
    with pytest.raises(BagError, match="definition of my_msgs/msg/Thing cannot be understood"):
        parse_definitions("my_msgs/msg/Thing", text)
