"""Sessions as recordings of rerun: read back by rerun itself, and compared with the messages."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point
from rclpy.serialization import serialize_message
from std_msgs.msg import String
from visualization_msgs.msg import Marker, MarkerArray

from us_sim.command.rerun import to_rerun
from us_sim.errors import BagError
from us_sim.geometry.pose import Pose
from us_sim.nodes.messages import (
    affine_message,
    cloud_message,
    colour_image_message,
    field_message,
    image_message,
    mesh_message,
    stamp_message,
    surface_marker,
    tetrahedra_message,
    transform_message,
    wrench_message,
)
from us_sim.nodes.sessions.attachments import session_attachments
from us_sim.nodes.settings import SessionRecorderSettings
from us_sim.nodes.tf import TFMessage
from us_sim.recording.writer import BagWriter
from us_sim.scene.building import tissue_model_of, volume_of
from us_sim.scene.reading import load_scene

EPOCH = 1_700_000_000_000_000_000
MS = 1_000_000
STAMP = stamp_message(EPOCH)
CLOUD, IMAGE, MATRIX = (
    "sensor_msgs/msg/PointCloud2",
    "sensor_msgs/msg/Image",
    "std_msgs/msg/Float64MultiArray",
)
SQUARE = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.1, 0.1, 0.0], [0.0, 0.1, 0.0]])
HALVES = np.array([[0, 1, 2], [0, 2, 3]])
NAMES = ("x", "y", "z")
MISSING = "rerun-sdk, the extra `rerun`, is not installed"


def quietly(fraction, text):
    assert 0.0 <= fraction <= 1.0
    assert text


@pytest.fixture
def session(tmp_path):
    """Writes a bag of (topic, type, message or bytes, ns after EPOCH when it was recorded)."""

    def write(*messages, attached=()):
        file = tmp_path / "session.mcap"
        with BagWriter(file) as writer:
            for topic, type_name in dict.fromkeys((topic, name) for topic, name, *_ in messages):
                writer.add_topic(topic, type_name)
            for topic, _, message, after in messages:
                data = message if isinstance(message, bytes) else serialize_message(message)
                writer.write(topic, data, EPOCH + after)
            for name, (media_type, data) in dict(attached).items():
                writer.attach(name, media_type, data, EPOCH)
        return file

    return write


@pytest.fixture
def converted(session, tmp_path):
    """Rows of rerun: ((stamp, recorded) in ns after EPOCH, value) by entity and component."""
    pytest.importorskip("rerun", reason=MISSING)
    from rerun.chunk import RrdReader

    def convert(*messages, attached=()):
        file = tmp_path / "session.rrd"
        said = to_rerun(session(*messages, attached=attached), file, quietly)
        found = {}
        for chunk in RrdReader(file).stream():
            rows = chunk.to_record_batch().to_pydict()
            stamps, recorded = rows.pop("stamp", None), rows.pop("recorded", None)
            for component, values in rows.items():
                rows_of = found.setdefault((chunk.entity_path.lstrip("/"), component), [])
                for row, value in enumerate(values):
                    if value is not None:
                        times = stamps and (after(stamps[row]), after(recorded[row]))
                        rows_of.append((times, value))
        for rows_of in found.values():
            rows_of.sort(key=lambda row: row[0] or ())
        return SimpleNamespace(said=said, rows=found)

    return convert


def after(moment):
    """ns after EPOCH, to a microsecond."""
    return round((moment.timestamp() - EPOCH / 1e9) * 1e6) * 1000


def cloud(points, stamp=EPOCH):
    return cloud_message(dict(zip(NAMES, points.T, strict=True)), stamp_message(stamp), "patient")


def test_the_skin_is_one_mesh_that_deforms(converted):
    pressed = SQUARE + np.array([0.0, 0.0, 0.004])
    marker = bytes(surface_marker(SQUARE, HALVES, STAMP, "patient", 0.5))
    found = converted(
        ("/skin/mesh", "shape_msgs/msg/Mesh", mesh_message(SQUARE, HALVES), 0),
        ("/skin/nodes", CLOUD, cloud(SQUARE), 3 * MS),
        ("/skin/nodes", CLOUD, cloud(pressed, EPOCH + 16 * MS), 20 * MS),
        ("/skin/marker", "visualization_msgs/msg/Marker", marker, 21 * MS),
    )
    assert found.said == []
    triangles = found.rows["skin", "Mesh3D:triangle_indices"]
    np.testing.assert_array_equal(triangles[0][1], HALVES)
    positions = found.rows["skin", "Mesh3D:vertex_positions"]
    assert [times for times, _ in positions] == [(0, 3 * MS), (16 * MS, 20 * MS)]
    np.testing.assert_allclose(positions[0][1], SQUARE, atol=1e-8)
    np.testing.assert_allclose(positions[1][1], pressed, atol=1e-8)
    np.testing.assert_allclose(found.rows["skin", "Mesh3D:vertex_normals"][1][1], [[0, 0, 1]] * 4)
    assert found.rows["skin", "CoordinateFrame:frame"][0][1] == ["patient"]
    assert not any(entity == "skin/marker" for entity, _ in found.rows)  # the same surface


def test_the_image_is_as_it_was_and_where_it_was_cut(converted):
    pixels = np.arange(12, dtype=np.uint8).reshape(3, 4)
    to_probe = np.array([[1e-3, 0, 0, -1.5e-3], [0, 0, -1, 0], [0, 2e-3, 0, 1e-3], [0, 0, 0, 1.0]])
    found = converted(
        ("/ultrasound/image_to_probe", MATRIX, affine_message(to_probe), 0),
        ("/ultrasound/image", IMAGE, image_message(pixels, STAMP, "probe"), 5 * MS),
    )
    ((times, values),) = found.rows["ultrasound/image", "Image:buffer"]
    assert times == (0, 5 * MS)
    np.testing.assert_array_equal(np.array(values[0], dtype=np.uint8).reshape(3, 4), pixels)
    corners = found.rows["ultrasound/plane", "Mesh3D:vertex_positions"][0][1]
    # four columns of 1 mm around x = 0, three rows of 2 mm from the face on, in the plane y = 0
    expected = [[-2e-3, 0, 0], [2e-3, 0, 0], [2e-3, 0, 6e-3], [-2e-3, 0, 6e-3]]
    np.testing.assert_allclose(corners, expected, atol=1e-9)
    texture = found.rows["ultrasound/plane", "Mesh3D:albedo_texture_buffer"][0][1][0]
    assert np.array(texture, dtype=np.uint8).reshape(3, 4, 3)[2, 3].tolist() == [11, 11, 11]
    assert found.rows["ultrasound/plane", "CoordinateFrame:frame"][0][1] == ["probe"]


def test_colours_and_fields_are_kept_and_other_encodings_are_said(converted):
    colour = np.arange(18, dtype=np.uint8).reshape(2, 3, 3)
    field = np.array([[0.5, np.nan]], dtype=np.float32)
    odd = image_message(np.zeros((1, 2), np.uint8), STAMP, "camera")
    odd.encoding = "yuv422"
    found = converted(
        ("/ultrasound/image_annotated", IMAGE, colour_image_message(colour, STAMP, "probe"), 0),
        ("/ultrasound/strain", IMAGE, field_message(field, STAMP, "probe"), 0),
        ("/camera/image_raw", IMAGE, odd, 0),
    )
    buffer = found.rows["ultrasound/image_annotated", "Image:buffer"][0][1][0]
    assert bytes(buffer) == colour.tobytes()
    tensor = found.rows["ultrasound/strain", "Tensor:data"][0][1][0]
    assert tensor["shape"] == [1, 2]
    np.testing.assert_array_equal(tensor["buffer"], field[0])
    (said,) = found.said
    assert "/camera/image_raw" in said
    assert "yuv422" in said


@pytest.mark.skipif(TFMessage is None, reason="tf2_msgs is not installed")
def test_the_probe_its_force_and_how_the_nodes_are(converted):
    pose = Pose([0.01, 0.02, 0.03], [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
    frames = TFMessage(transforms=[transform_message(pose, STAMP, "patient", "probe")])
    wrench = wrench_message(np.array([1.0, -2.0, -15.0]), np.zeros(3), STAMP, "probe")
    values = [KeyValue(key="rate_hz", value="59.5"), KeyValue(key="state", value="imaging")]
    status = DiagnosticStatus(
        name="/slice_interpolator", message="imaging", level=DiagnosticStatus.OK, values=values
    )
    report = DiagnosticArray(status=[status])
    report.header.stamp = STAMP
    diagnostics = "diagnostic_msgs/msg/DiagnosticArray"
    found = converted(
        ("/tf", "tf2_msgs/msg/TFMessage", frames, MS),
        ("/probe/wrench", "geometry_msgs/msg/WrenchStamped", wrench, 2 * MS),
        ("/diagnostics", diagnostics, report, 3 * MS),
        ("/diagnostics", diagnostics, report, 4 * MS),
        ("/session/marker", "std_msgs/msg/String", String(data="needle in"), 5 * MS),
    )
    rows = {key: [value for _, value in values] for key, values in found.rows.items()}
    np.testing.assert_allclose(
        rows["tf/probe", "Transform3D:translation"][0][0], pose.position, atol=1e-8
    )
    np.testing.assert_allclose(
        rows["tf/probe", "Transform3D:quaternion"][0][0], pose.orientation, atol=1e-7
    )
    assert rows["tf/probe", "Transform3D:parent_frame"] == [["patient"]]
    assert rows["tf/probe", "Transform3D:child_frame"] == [["probe"]]
    assert found.rows["tf/probe", "Transform3D:translation"][0][0] == (0, MS)
    arrow = rows["probe/wrench", "Arrows3D:vectors"][0][0]
    np.testing.assert_allclose(arrow, [0.002, -0.004, -0.03], atol=1e-9)  # 2 mm a newton
    assert rows["probe/wrench/force", "Scalars:scalars"] == [[1.0, -2.0, -15.0]]
    rates = rows["diagnostics/rate/slice_interpolator", "Scalars:scalars"]
    assert rates == [[59.5], [59.5]]
    states = rows["diagnostics/state/slice_interpolator", "TextLog:text"]
    assert states == [["slice_interpolator: imaging"]]  # once, as it did not change
    assert found.rows["session/marker", "TextLog:text"] == [((5 * MS, 5 * MS), ["needle in"])]


def test_markers_are_where_their_poses_say_until_they_are_deleted(converted):
    marker = Marker(ns="vein", id=3, type=Marker.TRIANGLE_LIST, action=Marker.ADD)
    marker.header.stamp, marker.header.frame_id = STAMP, "patient"
    marker.pose.position.z = 0.01
    marker.pose.orientation.z = marker.pose.orientation.w = np.sqrt(0.5)  # x becomes y
    marker.points = [Point(x=x, y=y, z=0.0) for x, y in ((0.0, 0.0), (0.1, 0.0), (0.0, 0.1))]
    marker.color.r, marker.color.a = 1.0, 0.5
    gone = Marker(ns="vein", id=3, action=Marker.DELETE)
    gone.header.stamp = stamp_message(EPOCH + MS)
    mesh = Marker(ns="probe", type=Marker.MESH_RESOURCE)
    kind = "visualization_msgs/msg/MarkerArray"
    found = converted(
        ("/tissue/structures", kind, MarkerArray(markers=[marker]), 0),
        ("/tissue/structures", kind, MarkerArray(markers=[gone]), MS),
        ("/probe/marker", kind, MarkerArray(markers=[mesh]), 2 * MS),
    )
    entity = "tissue/structures/vein/3"
    ((_, corners),) = found.rows[entity, "Mesh3D:vertex_positions"]
    np.testing.assert_allclose(corners, [[0, 0, 0.01], [0, 0.1, 0.01], [-0.1, 0, 0.01]], atol=1e-8)
    assert found.rows[entity, "Mesh3D:albedo_factor"][0][1] == [0xFF00007F]
    assert found.rows[entity, "Clear:is_recursive"] == [((MS, MS), [False])]
    (said,) = found.said
    assert "/probe/marker" in said
    assert "type 10" in said


@pytest.mark.parametrize(
    ("kind", "component", "expected"),
    [
        (Marker.ARROW, "Arrows3D:vectors", [[0.0, 0.04, 0.0]]),
        (Marker.CUBE, "Boxes3D:half_sizes", [[0.02, 0.01, 0.005]]),
        (Marker.SPHERE, "Ellipsoids3D:half_sizes", [[0.02, 0.01, 0.005]]),
        (Marker.CYLINDER, "Cylinders3D:lengths", [0.01]),
        (Marker.LINE_STRIP, "LineStrips3D:strips", [[[0.0, 0.1, 0.0], [0.0, 0.2, 0.0]]]),
        (Marker.LINE_LIST, "LineStrips3D:strips", [[[0.0, 0.1, 0.0], [0.0, 0.2, 0.0]]]),
        (Marker.SPHERE_LIST, "Ellipsoids3D:centers", [[0.0, 0.1, 0.0], [0.0, 0.2, 0.0]]),
        (Marker.POINTS, "Points3D:positions", [[0.0, 0.1, 0.0], [0.0, 0.2, 0.0]]),
        (Marker.TEXT_VIEW_FACING, "Points3D:labels", ["here"]),
    ],
)
def test_every_shape_of_markers(converted, kind, component, expected):
    marker = Marker(ns="n", type=kind, text="here")
    marker.header.stamp, marker.header.frame_id = STAMP, "patient"
    marker.pose.orientation.z = marker.pose.orientation.w = np.sqrt(0.5)  # x becomes y
    marker.scale.x, marker.scale.y, marker.scale.z = 0.04, 0.02, 0.01
    if kind not in (Marker.ARROW, Marker.CUBE, Marker.SPHERE, Marker.CYLINDER):
        marker.points = [Point(x=0.1, y=0.0, z=0.0), Point(x=0.2, y=0.0, z=0.0)]
    found = converted(("/mine", "visualization_msgs/msg/Marker", marker, 0))
    ((_, value),) = found.rows["mine/n", component]
    if component.endswith("labels"):
        assert value == expected
    else:
        np.testing.assert_allclose(value, expected, atol=1e-8)


def test_structures_that_nobody_recorded_follow_from_the_scene(converted, small_scene, tmp_path):
    corners = [((0, 0, 10), (5, 0, 10), (0, 5, 20)), ((5, 0, 10), (5, 5, 20), (0, 5, 20))]
    facets = "".join(
        "facet normal 0 0 1\nouter loop\n"
        + "".join(f"vertex {x} {y} {z}\n" for x, y, z in three)
        + "endloop\nendfacet\n"
        for three in corners
    )
    (tmp_path / "vein.stl").write_text(f"solid vein\n{facets}endsolid vein\n")
    file = tmp_path / "veins.yaml"
    wanted = "structures: {vein: {file: vein.stl, unit: 1 mm}}\n"
    file.write_text(small_scene.read_text() + wanted)
    scene = load_scene(file)
    mesh = tissue_model_of(scene, volume_of(scene)).mesh
    flat = mesh.nodes * [1.0, 1.0, 0.5]
    tetrahedra = tetrahedra_message(mesh.tetrahedra)
    found = converted(
        ("/tissue/rest", CLOUD, cloud(mesh.nodes, 0), 0),
        ("/tissue/tetrahedra", "std_msgs/msg/Int32MultiArray", tetrahedra, 0),
        ("/tissue/nodes", CLOUD, cloud(mesh.nodes), MS),
        ("/tissue/nodes", CLOUD, cloud(flat, EPOCH + 16 * MS), 17 * MS),
        attached=session_attachments(SessionRecorderSettings(scene=str(file))).items(),
    )
    assert found.said == []
    entity = "tissue/structures/vein"
    at_rest, pressed = (np.array(v) for _, v in found.rows[entity, "Mesh3D:vertex_positions"])
    assert sorted({round(1000 * z) for z in at_rest[:, 2]}) == [10, 20]
    np.testing.assert_allclose(pressed, at_rest * [1.0, 1.0, 0.5], atol=1e-7)
    assert found.rows[entity, "Mesh3D:albedo_factor"][0][1] == [0x4066D9FF]  # blue
    nodes = found.rows["tissue/nodes", "Points3D:positions"]
    np.testing.assert_allclose(nodes[1][1], flat, atol=1e-7)
    assert not any(entity == "tissue/rest" for entity, _ in found.rows)


def test_structures_are_left_out_where_no_scene_is_attached(converted):
    block = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) / 10
    tetrahedra = tetrahedra_message(np.array([[0, 1, 2, 3]]))
    found = converted(
        ("/tissue/rest", CLOUD, cloud(block, 0), 0),
        ("/tissue/tetrahedra", "std_msgs/msg/Int32MultiArray", tetrahedra, 0),
        ("/tissue/nodes", CLOUD, cloud(block), MS),
    )
    (said,) = found.said
    assert said.startswith("the structures of the scene are left out: ")
    nodes = found.rows["tissue/nodes", "Points3D:positions"]
    np.testing.assert_allclose(nodes[0][1], block, atol=1e-8)


def test_nothing_is_overwritten_and_nothing_half_is_left(session, tmp_path):
    pytest.importorskip("rerun", reason=MISSING)
    bag = session(("/skin/nodes", CLOUD, cloud(SQUARE), 0))
    there = tmp_path / "there.rrd"
    there.write_bytes(b"precious")
    with pytest.raises(BagError, match=r"there\.rrd exists already"):
        to_rerun(bag, there, quietly)
    assert there.read_bytes() == b"precious"
    with pytest.raises(BagError, match=r"no\.mcap"):
        to_rerun(tmp_path / "no.mcap", tmp_path / "a.rrd", quietly)
    (tmp_path / "file").write_text("")
    with pytest.raises(BagError, match="cannot be written"):
        to_rerun(bag, tmp_path / "file" / "a.rrd", quietly)

    def stopped(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        to_rerun(bag, tmp_path / "b.rrd", stopped)
    assert sorted(path.name for path in tmp_path.glob("*.rrd*")) == ["there.rrd"]


def test_a_bag_without_anything_to_show_is_refused(session, tmp_path):
    pytest.importorskip("rerun", reason=MISSING)
    bag = session(("/probe/speed", "std_msgs/msg/Float64", bytes.fromhex("00010000") + bytes(8), 0))
    with pytest.raises(BagError, match="no messages"):
        to_rerun(bag, tmp_path / "a.rrd", quietly)


def test_without_rerun_or_with_an_old_one_it_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(BagError, match=r"not installed: pip install 'rerun-sdk>=0\.41'"):
        to_rerun(tmp_path / "session.mcap", tmp_path / "a.rrd", quietly)
    monkeypatch.setitem(sys.modules, "rerun", SimpleNamespace(__version__="0.22.1"))
    with pytest.raises(BagError, match=r"rerun 0\.22\.1 is too old"):
        to_rerun(tmp_path / "session.mcap", tmp_path / "a.rrd", quietly)
