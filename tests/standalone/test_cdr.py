"""Messages to bytes and back, against rosbags, and how long that takes."""

import array
import struct
import timeit

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from us_sim.standalone.messages import (
    CdrError,
    deserialize,
    message_class,
    serialize,
)

Image = message_class("sensor_msgs/msg/Image")
PoseStamped = message_class("geometry_msgs/msg/PoseStamped")
Point = message_class("geometry_msgs/msg/Point")

typestore = get_typestore(Stores.ROS2_JAZZY)
text = st.text(max_size=9)
number = st.floats(allow_nan=False)
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


def test_an_image_takes_less_than_a_tenth_of_a_millisecond_each_way():
    image = Image(height=512, width=512, encoding="mono8", step=512)
    image.data = array.array("B", bytes(512 * 512))
    data = serialize(image)
    assert min(timeit.repeat(lambda: serialize(image), number=20, repeat=10)) / 20 < 1e-4
    assert min(timeit.repeat(lambda: deserialize(data, Image), number=20, repeat=10)) / 20 < 1e-4


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
