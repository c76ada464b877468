"""Messages without ROS 2 against those of real rclpy, rosidl, rosbag2 and rosbags."""

import array
import contextlib
import json
import re
import struct
import subprocess
import sys
import time
import timeit
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from us_sim.standalone.cdr import CdrError, deserialize, serialize
from us_sim.standalone.interfaces import (
    InterfaceError,
    _typestore,
    interface,
    message_names,
    packages,
    service_names,
    type_hash,
)
from us_sim.standalone.messages import message_class, service_class

Image = message_class("sensor_msgs/msg/Image")
PoseStamped = message_class("geometry_msgs/msg/PoseStamped")
Point = message_class("geometry_msgs/msg/Point")


def build(name: str, values: dict[str, Any]) -> Any:
    """A message from the nested dictionaries of messages.json."""
    arguments = {}
    for field in interface(name).fields:
        value = values[field.name]
        if field.is_message:
            if field.shape == "scalar":
                value = build(field.kind, value)
            else:
                value = [build(field.kind, element) for element in value]
        elif field.kind == "byte" and field.shape == "scalar":
            value = value.encode("latin1")
        arguments[field.name] = value
    return message_class(name)(**arguments)


@pytest.fixture(scope="session")
def rclpy_messages(shared_data: Path) -> list[dict[str, Any]]:
    return json.loads((shared_data / "ros2-jazzy" / "messages.json").read_text())


def test_every_message_of_rclpy_is_reproduced_byte_for_byte(rclpy_messages):
    assert len(rclpy_messages) == 15
    for entry in rclpy_messages:
        message = build(entry["type"], entry["fields"])
        assert serialize(message).hex() == entry["cdr_hex"], entry["type"]


def test_every_message_of_rclpy_is_read_back(rclpy_messages):
    for entry in rclpy_messages:
        data = bytes.fromhex(entry["cdr_hex"])
        cls = message_class(entry["type"])
        assert serialize(deserialize(data, cls)) == data
        assert serialize(deserialize(memoryview(data), cls)) == data


def test_fields_have_the_python_types_of_rclpy(rclpy_messages):
    def python_type(value: Any) -> str:
        name = type(value).__name__
        return f"array({value.typecode})" if name == "array" else name

    for entry in rclpy_messages:
        data, cls = bytes.fromhex(entry["cdr_hex"]), message_class(entry["type"])
        for message in (cls(), deserialize(data, cls)):
            types = {name: python_type(getattr(message, name)) for name in entry["fields"]}
            assert types == entry["python_field_types"], entry["type"]


def test_type_hashes_are_those_that_rosbag2_recorded(shared_data):
    hashes = {}
    for path in (shared_data / "ros2-jazzy" / "bags").rglob("metadata.yaml"):
        text = path.read_text()
        pattern = r"type: (\S+)\n(?:.*\n)*?\s+type_description_hash: (RIHS01_\w{64})"
        hashes.update(re.findall(pattern, text))
    assert "geometry_msgs/msg/PoseStamped" in hashes
    assert "sensor_msgs/msg/CameraInfo" in hashes
    assert {name: type_hash(name) for name in hashes} == hashes


def test_type_hashes_are_those_of_jazzys_own_packages():
    # From share/*/*/*.json of a Jazzy installation; sixteen digits will do.
    hashes = {
        "rmw_dds_common/msg/ParticipantEntitiesInfo": "91a0593bacdcc50e",
        "std_msgs/msg/Char": "3ad2d04dd29ba19d",
        "visualization_msgs/msg/MarkerArray": "86cb8800b6fb05b5",
        "diagnostic_msgs/msg/DiagnosticArray": "5a8a36efb05fb250",
    }
    assert {name: type_hash(name).removeprefix("RIHS01_")[:16] for name in hashes} == hashes


@pytest.mark.parametrize(
    ("service", "expected"),
    [
        ("rcl_interfaces/srv/SetParameters", "56eed9a67e169f9c"),
        ("rcl_interfaces/srv/ListParameters", "3e6062bfbb27bfb8"),
        ("std_srvs/srv/Trigger", "eeff2cd6fa5ad9d2"),
    ],
)
def test_requests_and_responses_make_up_jazzys_services(monkeypatch, service, expected):
    store = _typestore()

    def message(part):
        return Nodetype.NAME, f"{service}_{part}"

    event = [
        ("info", (Nodetype.NAME, "service_msgs/msg/ServiceEventInfo")),
        ("request", (Nodetype.SEQUENCE, (message("Request"), 1))),
        ("response", (Nodetype.SEQUENCE, (message("Response"), 1))),
    ]
    whole = [
        (f"{part.lower()}_message", message(part)) for part in ("Request", "Response", "Event")
    ]
    monkeypatch.setitem(store.fielddefs, f"{service}_Event", ([], event))
    monkeypatch.setitem(store.fielddefs, service, ([], whole))
    assert store.hash_rihs01(service).removeprefix("RIHS01_")[:16] == expected


@pytest.mark.parametrize("package", packages())
def test_every_message_survives_its_own_bytes(package):
    names = [f"{package}/msg/{name}" for name in message_names(package)]
    names += [
        f"{package}/srv/{name}_{part}"
        for name in service_names(package)
        for part in ("Request", "Response")
    ]
    for name in names:
        cls = message_class(name)
        assert deserialize(serialize(cls()), cls) == cls()


def test_a_truncated_message_is_refused_wherever_it_ends(rclpy_messages):
    for entry in rclpy_messages:
        data = bytes.fromhex(entry["cdr_hex"])
        cls = message_class(entry["type"])
        for end in range(len(data)):
            with pytest.raises(CdrError, match=entry["type"]):
                deserialize(data[:end], cls)


def test_defaults_are_rosidls():
    pose = PoseStamped().pose
    assert (pose.orientation.x, pose.orientation.w) == (0.0, 1.0)
    assert type(pose.orientation).W__DEFAULT == 1.0
    info = message_class("sensor_msgs/msg/CameraInfo")()
    assert info.k.dtype == np.float64
    assert info.k.tolist() == [0.0] * 9
    assert info.d == array.array("d")
    assert message_class("diagnostic_msgs/msg/DiagnosticStatus")().level == b"\x00"
    assert message_class("rcl_interfaces/msg/ParameterValue")().bool_array_value == []
    assert message_class("sensor_msgs/msg/NavSatStatus")().status == -2
    assert Image().data is not Image().data
    assert PoseStamped().pose is not PoseStamped().pose


def test_constants_are_class_attributes():
    assert message_class("sensor_msgs/msg/PointField").FLOAT32 == 7
    assert message_class("visualization_msgs/msg/Marker").TRIANGLE_LIST == 11
    assert message_class("rcl_interfaces/msg/ParameterType").PARAMETER_STRING_ARRAY == 9
    assert message_class("diagnostic_msgs/msg/DiagnosticStatus").STALE == b"\x03"
    assert service_class("rcl_interfaces/srv/ListParameters").Request.DEPTH_RECURSIVE == 0


def test_fields_are_described_as_rosidl_does():
    assert Image.get_fields_and_field_types() == {
        "header": "std_msgs/Header",
        "height": "uint32",
        "width": "uint32",
        "encoding": "string",
        "is_bigendian": "uint8",
        "step": "uint32",
        "data": "sequence<uint8>",
    }
    described = {
        "sensor_msgs/msg/CameraInfo": ("k", "double[9]"),
        "diagnostic_msgs/msg/DiagnosticStatus": ("level", "octet"),
        "sensor_msgs/msg/PointCloud2": ("is_dense", "boolean"),
        "shape_msgs/msg/SolidPrimitive": ("dimensions", "sequence<double, 3>"),
        "rmw_dds_common/msg/NodeEntitiesInfo": ("node_name", "string<256>"),
        "rmw_dds_common/msg/Gid": ("data", "uint8[16]"),
        "rcl_interfaces/msg/ParameterDescriptor": (
            "integer_range",
            "sequence<rcl_interfaces/IntegerRange, 1>",
        ),
    }
    for name, (field, idl_type) in described.items():
        assert message_class(name).get_fields_and_field_types()[field] == idl_type
    assert Image.__slots__[-1] == "_data"


def test_repr_and_equality():
    image = Image(width=2, data=[1, 2])
    assert repr(image).endswith("width=2, encoding='', is_bigendian=0, step=0, data=[1, 2])")
    assert repr(image).startswith("sensor_msgs.msg.Image(header=std_msgs.msg.Header(stamp=")
    assert repr(Image()).endswith("data=[])")
    assert image == Image(width=2, data=b"\1\2")
    assert image != Image(width=2, data=b"\1\3")
    assert image != "an image"
    with pytest.raises(TypeError):
        hash(image)
    info = message_class("sensor_msgs/msg/CameraInfo")
    assert info(k=np.arange(9.0)) == info(k=list(np.arange(9.0)))
    assert info(k=np.arange(9.0)) != info()


@pytest.mark.parametrize(
    "value",
    [
        array.array("B", [0, 255]),
        [0, 255],
        (0, 255),
        b"\x00\xff",
        bytearray(b"\x00\xff"),
        np.array([0, 255], np.uint8),
    ],
)
def test_a_byte_sequence_is_filled_from(value):
    image = Image()
    image.data = value
    assert image.data == array.array("B", [0, 255])
    assert type(image.data) is array.array
    if isinstance(value, array.array):
        assert image.data is value


@pytest.mark.parametrize(
    ("name", "field", "value", "sentence"),
    [
        ("geometry_msgs/msg/Point", "x", 1, "must be of type 'float'"),
        ("geometry_msgs/msg/Point", "x", np.float32(1), "must be of type 'float'"),
        ("std_msgs/msg/Float32", "data", 1e39, "must be a float in"),
        ("sensor_msgs/msg/Image", "height", 1.0, "must be of type 'int'"),
        ("sensor_msgs/msg/Image", "height", -1, "unsigned integer in [0, 4294967295]"),
        ("std_msgs/msg/Int8", "data", 128, "an integer in [-128, 127]"),
        ("sensor_msgs/msg/Image", "encoding", b"mono8", "must be of type 'str'"),
        ("sensor_msgs/msg/Image", "header", None, "sub message of type 'Header'"),
        ("sensor_msgs/msg/PointCloud2", "is_dense", 1, "must be of type 'bool'"),
        ("diagnostic_msgs/msg/DiagnosticStatus", "level", 1, "'bytes'"),
        ("sensor_msgs/msg/Image", "data", [256], "unsigned integer in [0, 255]"),
        ("sensor_msgs/msg/Image", "data", [1.0], "must be of type 'int'"),
        ("sensor_msgs/msg/Image", "data", array.array("b", [1]), "type code of 'B'"),
        ("sensor_msgs/msg/Image", "data", np.zeros(2), "ndarray of uint8"),
        ("sensor_msgs/msg/Image", "data", np.zeros((2, 2), np.uint8), "shape (2, 2)"),
        ("sensor_msgs/msg/Image", "data", "text", "set or sequence"),
        ("sensor_msgs/msg/Image", "data", 3, "set or sequence"),
        ("sensor_msgs/msg/CameraInfo", "k", [1.0], "with length 9"),
        ("sensor_msgs/msg/CameraInfo", "k", np.zeros(8), "size of 9"),
        ("sensor_msgs/msg/CameraInfo", "k", np.zeros(9, np.float32), "numpy.float64"),
        ("shape_msgs/msg/SolidPrimitive", "dimensions", [0.0] * 4, "<= 3"),
        ("diagnostic_msgs/msg/DiagnosticStatus", "values", ["a"], "type 'KeyValue'"),
        ("rcl_interfaces/msg/ParameterDescriptor", "integer_range", [1, 2], "length <= 1"),
        ("rmw_dds_common/msg/NodeEntitiesInfo", "node_name", "n" * 257, "not longer than 256"),
    ],
)
def test_a_wrong_value_is_refused_with_rosidls_words(name, field, value, sentence):
    message = message_class(name)()
    before = repr(message)
    with pytest.raises(AssertionError, match=re.escape(sentence)):
        setattr(message, field, value)
    with pytest.raises(AssertionError, match=re.escape(sentence)):
        message_class(name)(**{field: value})
    assert repr(message) == before


def test_an_unknown_argument_is_refused():
    with pytest.raises(AssertionError, match="Invalid arguments passed to constructor: w"):
        Point(w=1.0)
    with pytest.raises(AttributeError):
        Point().w = 1.0


def test_infinity_and_nan_are_floats():
    point = Point(x=float("inf"), y=float("nan"))
    read = deserialize(serialize(point), Point)
    assert read.x == np.inf
    assert np.isnan(read.y)


def test_services():
    trigger = service_class("std_srvs/srv/Trigger")
    assert serialize(trigger.Request()).hex() == "0001000000"
    response = trigger.Response(success=True, message="ok")
    assert serialize(response).hex() == "0001000001000000030000006f6b00"
    assert deserialize(serialize(response), trigger.Response) == response
    with pytest.raises(TypeError, match="instantiated"):
        trigger()
    assert service_names("rcl_interfaces") == [
        "DescribeParameters",
        "GetParameterTypes",
        "GetParameters",
        "ListParameters",
        "SetParameters",
        "SetParametersAtomically",
    ]


@pytest.mark.parametrize("name", ["sensor_msgs/msg/Imag", "Image", "", "std_srvs/srv/Trigger_"])
def test_an_unknown_message_is_named(name):
    with pytest.raises(InterfaceError, match="there is no message"):
        message_class(name)
    with pytest.raises(InterfaceError, match="there is no interface"):
        type_hash(name)


@pytest.mark.parametrize("name", ["std_srvs/srv/Triger", "std_msgs/msg/String", "Trigger"])
def test_an_unknown_service_is_named(name):
    with pytest.raises(InterfaceError, match="there is no service"):
        service_class(name)


MODULES = """
import pickle, sys
from us_sim.standalone.messages import register_message_modules
assert "geometry_msgs" not in sys.modules
register_message_modules()
from geometry_msgs.msg import Point, PoseStamped
from rcl_interfaces.srv import GetParameters, GetParameters_Request
import std_msgs.msg, visualization_msgs.msg
assert GetParameters.Request is GetParameters_Request
assert type(PoseStamped().pose.position) is Point
assert pickle.loads(pickle.dumps(Point(x=2.0))) == Point(x=2.0)
assert "Marker" in dir(visualization_msgs.msg)
try:
    from std_msgs.msg import Nothing
except ImportError as error:
    print(error)
"""


def test_modules_are_importable_and_say_what_they_lack():
    result = subprocess.run(
        [sys.executable, "-c", MODULES], capture_output=True, text=True, check=True
    )
    assert "cannot import name 'Nothing' from 'std_msgs.msg'" in result.stdout


typestore = get_typestore(Stores.ROS2_JAZZY)
text = st.text(max_size=9)
number = st.floats(allow_nan=False)
any_type = st.sampled_from([f"{p}/msg/{name}" for p in packages() for name in message_names(p)])
points = st.lists(st.builds(Point, x=number, y=number, z=number), max_size=3)


@settings(max_examples=40, deadline=None)
@given(text, text, points, st.lists(text, max_size=3), st.binary(max_size=9), number)
def test_bytes_are_those_of_rosbags(namespace, label, corners, strings, data, length):
    marker = message_class("visualization_msgs/msg/Marker")(ns=namespace, text=label)
    marker.points = corners
    marker.mesh_file.data = data
    marker.scale.x = length
    value = message_class("rcl_interfaces/msg/ParameterValue")(string_array_value=strings)
    value.double_array_value = [corner.x for corner in corners]
    value.bool_array_value = [corner.x > 0 for corner in corners]
    for message in (marker, value):
        name = type(message).__msgtype__
        theirs = typestore.deserialize_cdr(serialize(message), name)
        assert bytes(typestore.serialize_cdr(theirs, name)) == serialize(message)
        assert deserialize(serialize(message), type(message)) == message


def test_big_endian_is_read():
    joy = struct.pack(">HHiII", 0, 0, 5, 7, 1) + b"\0\0\0\0" + struct.pack(">IfIi", 1, 0.5, 1, -2)
    message = deserialize(joy, message_class("sensor_msgs/msg/Joy"))
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (5, 7)
    assert (message.axes.tolist(), message.buttons.tolist()) == ([0.5], [-2])
    little = message_class("sensor_msgs/msg/CameraInfo")(k=np.arange(9.0))
    data = bytes(
        typestore.serialize_cdr(
            typestore.deserialize_cdr(serialize(little), "sensor_msgs/msg/CameraInfo"),
            "sensor_msgs/msg/CameraInfo",
            little_endian=False,
        )
    )
    assert deserialize(data, type(little)) == little


@pytest.mark.parametrize("data", [b"", b"\0", b"\0\3\0\0abc", b"\0\7\0\0", b"abcd"])
def test_another_encoding_is_refused(data):
    with pytest.raises(CdrError, match="only XCDR1"):
        deserialize(data, Point)


def test_text_that_is_not_utf8_is_refused():
    with pytest.raises(CdrError, match="std_msgs/msg/String"):
        deserialize(b"\0\1\0\0\2\0\0\0\xff\0", message_class("std_msgs/msg/String"))


@pytest.mark.parametrize("kind", ["byte", "bool", "string", "integer", "double"])
def test_a_sequence_that_claims_four_billion_elements_is_refused_at_once(kind):
    value = message_class("rcl_interfaces/msg/ParameterValue")()
    value.bool_value = True
    setattr(value, f"{kind}_array_value", [b"\1"] if kind == "byte" else [])
    data = serialize(value)
    for place in range(4, len(data) - 3, 4):
        claiming = data[:place] + b"\xff\xff\xff\xff" + data[place + 4 :]
        start = time.process_time()
        with contextlib.suppress(CdrError):
            deserialize(claiming, type(value))
        assert time.process_time() - start < 0.5


def test_a_sequence_beyond_its_bound_is_refused():
    Primitive = message_class("shape_msgs/msg/SolidPrimitive")
    data = serialize(Primitive(type=1, dimensions=[1.0, 2.0, 3.0]))
    assert list(deserialize(data, Primitive).dimensions) == [1.0, 2.0, 3.0]
    longer = data.replace(struct.pack("<I", 3), struct.pack("<I", 4), 1) + bytes(8)
    with pytest.raises(CdrError, match="4 elements"):
        deserialize(longer, Primitive)


@settings(max_examples=400, deadline=None)
@given(any_type, st.randoms(use_true_random=False), st.booleans())
def test_damaged_bytes_are_a_message_or_refused(name, random, little):
    cls = message_class(name)
    data = bytearray(serialize(cls())) + bytes(random.choice([0, 0, 8, 64]))
    data[1] = int(little)
    for _ in range(random.randint(0, 4)):
        place = random.randrange(4, len(data))
        data[place : place + 4] = random.choice([b"\xff" * 4, b"\0\0\0\x80", random.randbytes(4)])
    try:
        message = deserialize(data[: random.choice([len(data), random.randint(4, len(data))])], cls)
    except CdrError:
        return
    assert isinstance(message, cls)


def test_an_image_takes_about_as_long_as_copying_it():
    image = Image(height=512, width=512, encoding="mono8", step=512)
    image.data = array.array("B", bytes(512 * 512))
    data = serialize(image)
    ways = [lambda: bytearray(data), lambda: serialize(image), lambda: deserialize(data, Image)]
    copied, *both = (min(timeit.repeat(way, number=20, repeat=20)) for way in ways)
    assert max(both) < 12 * copied


def test_rosbags_own_functions_take_longer_even_for_its_own_messages():
    store = get_typestore(Stores.ROS2_JAZZY)
    marker = message_class("visualization_msgs/msg/Marker")(points=[Point()] * 300)
    for message in (PoseStamped(), marker):
        name, data = message.__msgtype__, serialize(message)
        theirs = store.deserialize_cdr(data, name)
        for ours, other in (
            (lambda m=message: serialize(m), lambda m=theirs, n=name: store.serialize_cdr(m, n)),
            (
                lambda d=data, m=message: deserialize(d, type(m)),
                lambda d=data, n=name: store.deserialize_cdr(d, n),
            ),
        ):
            times = [min(timeit.repeat(f, number=20, repeat=10)) for f in (ours, other)]
            assert times[0] < times[1], name
