"""Arrays to messages and back, by their laws; what does not fit is one sentence."""

from array import array

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Image, PointCloud2, PointField
from std_msgs.msg import Float64MultiArray, Int32MultiArray
from visualization_msgs.msg import Marker, MarkerArray

from us_sim.errors import MeshError, MessageError, PoseError, ProbeError, StampError, VolumeError
from us_sim.geometry.pose import Pose
from us_sim.nodes.messages import (
    MarkerShape,
    affine_message,
    cloud_message,
    image_message,
    mesh_message,
    pose_message,
    pose_text,
    serialize_markers,
    stamp_message,
)
from us_sim.recording.decoding import (
    affine_from,
    mesh_from,
    nanoseconds_of,
    pixels_from,
    pose_from,
    pose_from_text,
    read_first_stamp,
    tetrahedra_from,
    triangles_from,
    vectors_from,
)

STAMP = Time(sec=3, nanosec=4)
quick = settings(max_examples=25, deadline=None)
floats = st.floats(-1e3, 1e3, width=32)
points = arrays(np.float64, st.tuples(st.integers(1, 20), st.just(3)), elements=floats)


@quick
@given(points, st.sampled_from(["<", ">"]), st.sampled_from([4, 8]), st.integers(0, 7))
def test_clouds_of_any_layout_are_read(vectors, order, size, padding):
    kind = {4: PointField.FLOAT32, 8: PointField.FLOAT64}[size]
    offsets = [padding + size * k for k in (2, 0, 1)]
    layout = np.dtype(
        {
            "names": ["x", "y", "z"],
            "formats": [f"{order}f{size}"] * 3,
            "offsets": offsets,
            "itemsize": padding + 3 * size + 2,
        }
    )
    table = np.zeros(len(vectors), layout)
    for name, column in zip("xyz", vectors.T, strict=True):
        table[name] = column
    message = PointCloud2(
        height=1,
        width=len(vectors),
        is_bigendian=order == ">",
        point_step=layout.itemsize,
        row_step=layout.itemsize * len(vectors),
        data=array("B", table.tobytes()),
        fields=[
            PointField(name=name, offset=offset, datatype=kind, count=1)
            for name, offset in zip("xyz", offsets, strict=True)
        ],
    )
    np.testing.assert_array_equal(vectors_from(message), vectors)


def test_poses_round_trip():
    pose = Pose([0.1, -0.2, 0.3], [0.5, -0.5, 0.5, 0.5])
    message = pose_message(pose, STAMP, "patient")
    assert (message.header.stamp, message.header.frame_id) == (STAMP, "patient")
    np.testing.assert_array_equal(pose_from(message).matrix, pose.matrix)


def test_a_pose_farther_away_than_any_place_is_refused():
    for axis in np.eye(3):
        pose_from(pose_message(Pose(-9e6 * axis), STAMP, "patient"))
        with pytest.raises(PoseError, match="metres"):
            pose_from(pose_message(Pose(-2e7 * axis), STAMP, "patient"))


def test_a_mesh_has_vertices_and_triangles():
    mesh = mesh_message(np.eye(3), np.array([[2, 1, 0]]))
    assert [list(t.vertex_indices) for t in mesh.triangles] == [[2, 1, 0]]
    assert [(v.x, v.y, v.z) for v in mesh.vertices] == [(1, 0, 0), (0, 1, 0), (0, 0, 1)]
    vertices, triangles = mesh_from(mesh)
    np.testing.assert_array_equal(vertices, np.eye(3))
    np.testing.assert_array_equal(triangles, [[2, 1, 0]])


def test_a_mesh_of_vertices_that_are_not_there_is_refused():
    with pytest.raises(MeshError, match="vertex 3"):
        mesh_from(mesh_message(np.eye(3), np.array([[2, 1, 3]])))
    with pytest.raises(MeshError, match="finite"):
        mesh_from(mesh_message(np.full((3, 3), np.inf), np.array([[2, 1, 0]])))


def cloud_of(x, y, z, frame="patient"):
    return cloud_message({"x": x, "y": y, "z": z}, STAMP, frame)


FLAT = cloud_message(dict.fromkeys("xy", np.zeros(2)), STAMP, "patient")


@pytest.mark.parametrize(
    ("read", "message", "error", "fact"),
    [
        (vectors_from, FLAT, MeshError, "'z'"),
        (tetrahedra_from, Int32MultiArray(data=array("i", range(5))), MeshError, "5 "),
        (tetrahedra_from, Int32MultiArray(data=array("i", [0, 1, -1, 2])), MeshError, "-1 "),
        (pixels_from, Image(encoding="rgb8"), VolumeError, "rgb8"),
        (pixels_from, Image(encoding="mono8", height=2, width=2, step=2), VolumeError, "0 bytes"),
    ],
)
def test_what_does_not_fit_is_refused(read, message, error, fact):
    with pytest.raises(error, match=fact):
        read(message)


@pytest.mark.parametrize(
    "sizes",
    [
        {"offset": 2**32 - 4},
        {"offset": 2**31 - 2},
        {"point_step": 0},
        {"point_step": 11},
        {"point_step": 2**32 - 1},
        {"width": 5},
        {"width": 1, "height": 2**32 - 1},
    ],
)
def test_clouds_whose_sizes_do_not_fit_their_data_are_refused(sizes):
    cloud = cloud_of(*np.ones((3, 2)))
    for name, value in sizes.items():
        setattr(cloud.fields[2] if name == "offset" else cloud, name, value)
    with pytest.raises(MeshError, match="24 bytes"):
        vectors_from(cloud)


@pytest.mark.parametrize(("rows", "columns", "step"), [(2, 9, 4), (0, 4, 4), (2, 0, 4)])
def test_images_whose_rows_do_not_hold_their_pixels_are_refused(rows, columns, step):
    image = Image(encoding="mono8", height=rows, width=columns, step=step, data=array("B", [1] * 8))
    with pytest.raises(VolumeError, match=f"{rows} .* {columns} .* {step} "):
        pixels_from(image)


@pytest.mark.parametrize("frame", ["", "/patient", "moon"])
def test_poses_and_clouds_of_another_frame_are_refused(frame):
    cloud = cloud_of(*np.ones((3, 2)), frame)
    for convert, message in (
        (vectors_from, cloud),
        (pose_from, pose_message(Pose(), STAMP, frame)),
    ):
        with pytest.raises(MessageError, match=f"'{frame}'.*'patient'"):
            convert(message, "patient")
        convert(message)


@pytest.mark.parametrize("nanoseconds", [0, 999_999_999, 1_234_567_890_123_456_789])
def test_stamps_round_trip(nanoseconds):
    assert nanoseconds_of(stamp_message(nanoseconds)) == nanoseconds


def test_stamps_that_are_no_time_are_refused():
    for stamp in (Time(sec=-1), Time(nanosec=10**9), Time(sec=2**31 - 1, nanosec=2**32 - 1)):
        with pytest.raises(StampError, match=f"{stamp.sec} .* {stamp.nanosec} "):
            nanoseconds_of(stamp)
    with pytest.raises(StampError, match="later"):
        stamp_message(2**31 * 10**9)
    assert stamp_message(-5) == Time()


@quick
@given(
    st.lists(
        st.tuples(st.text("abcdefg", max_size=9), points, st.integers(0, 5), st.integers(0, 2**16)),
        max_size=4,
    ),
    st.text("xyz", max_size=5),
)
def test_structure_markers_are_what_rclpy_would_serialize(surfaces, frame):
    expected = MarkerArray()
    given_ones = []
    for name, vertices, count, seed in surfaces:
        random = np.random.default_rng(seed)
        triangles = random.integers(0, len(vertices), (count, 3))
        colour = (0.25, 0.5, 0.75, 1.0)
        given_ones.append(MarkerShape(name, colour, vertices[triangles.ravel()]))
        marker = Marker(ns=name, type=Marker.TRIANGLE_LIST, action=Marker.ADD)
        marker.header.stamp, marker.header.frame_id = STAMP, frame
        marker.scale.x = marker.scale.y = marker.scale.z = marker.pose.orientation.w = 1.0
        marker.color.r, marker.color.g, marker.color.b, marker.color.a = colour
        marker.points = [Point(x=x, y=y, z=z) for x, y, z in vertices[triangles.ravel()].tolist()]
        expected.markers.append(marker)
    serialized = serialize_markers(given_ones, STAMP, frame)
    # Not byte for byte: what fills the gaps between numbers is up to the middleware.
    assert len(serialized) == len(serialize_message(expected))
    assert deserialize_message(serialized, MarkerArray) == expected
    assert read_first_stamp(serialized) == (nanoseconds_of(STAMP) if given_ones else None)


@quick
@given(arrays(np.uint8, st.tuples(st.integers(1, 9), st.integers(1, 9), st.just(3))))
def test_colour_images_hold_red_green_blue_of_each_pixel(pixels):
    for view in (pixels, pixels[:, ::-1]):
        message = image_message(view, STAMP, "probe")
        rows, columns = pixels.shape[:2]
        assert (message.height, message.width, message.encoding) == (rows, columns, "rgb8")
        assert message.step * rows == 3 * columns * rows == len(message.data)
        assert list(message.data) == view.ravel().tolist()


@quick
@given(arrays(np.float64, (3, 4), elements=st.floats(-1e6, 1e6)))
def test_affine_maps_round_trip(upper):
    matrix = np.vstack([upper, [0, 0, 0, 1]])
    sent = deserialize_message(serialize_message(affine_message(matrix)), Float64MultiArray)
    assert [(d.label, d.size, d.stride) for d in sent.layout.dim] == [
        ("row", 4, 16),
        ("column", 4, 4),
    ]
    assert list(sent.data) == matrix.ravel().tolist()  # row after row
    np.testing.assert_array_equal(affine_from(sent), matrix)


def test_what_is_no_affine_map_is_refused():
    with pytest.raises(ProbeError, match="4 by 4"):
        affine_from(Float64MultiArray())
    for diagonal in ([1.0, np.nan, 1.0, 1.0], [1.0, 1.0, 1.0, 2.0], [1e7, 1.0, 1.0, 1.0]):
        with pytest.raises(ProbeError, match="finite"):
            affine_from(affine_message(np.diag(diagonal)))


@pytest.mark.parametrize("wrong", ["nan", "two corners"])
def test_markers_that_are_no_triangles_are_refused(wrong):
    marker = Marker(type=Marker.TRIANGLE_LIST, ns="vein")
    last = Point(x=float("nan")) if wrong == "nan" else None
    marker.points = [Point(), Point(x=1.0), *([last] if last else [])]
    with pytest.raises(MeshError, match="vein: "):
        triangles_from(MarkerArray(markers=[marker]), "")


def test_a_markers_pose_places_its_triangles():
    marker = Marker(type=Marker.TRIANGLE_LIST, ns="bone")
    marker.points = [Point(), Point(x=1.0), Point(y=1.0)]
    marker.pose.position.z = 2.0
    marker.pose.orientation.w, marker.pose.orientation.z = 0.5**0.5, 0.5**0.5  # a quarter turn
    ((_, _, corners),) = triangles_from(MarkerArray(markers=[marker]), "")
    np.testing.assert_allclose(corners, [[0, 0, 2], [0, 1, 2], [-1, 0, 2]], atol=1e-12)


def test_a_pose_is_the_same_after_it_was_a_text():
    pose = Pose([0.1, -1 / 3, 2e-9], [0.5, -0.5, 0.5, 0.5])
    back = pose_from_text(pose_text(pose))
    np.testing.assert_array_equal(back.position, pose.position)
    np.testing.assert_array_equal(back.orientation, pose.orientation)
    for wrong in ("", "1 2 3", "a b c d e f g", "0 0 0 0 0 0 0", "nan 0 0 0 0 0 1"):
        with pytest.raises(PoseError):
            pose_from_text(wrong)
