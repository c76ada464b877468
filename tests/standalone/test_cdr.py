"""Messages to bytes and back, against rosbags, and how long that takes."""

import array
import contextlib
import struct
import time
import timeit

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from us_sim.standalone.cdr import CdrError, deserialize, serialize
from us_sim.standalone.interfaces import message_names, packages
from us_sim.standalone.messages import message_class

Image = message_class("sensor_msgs/msg/Image")
PoseStamped = message_class("geometry_msgs/msg/PoseStamped")
Point = message_class("geometry_msgs/msg/Point")

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
