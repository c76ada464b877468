"""Poses from a pyigtl server to probe/pose, and the image from the graph to a pyigtl client."""

import numpy as np
import pyigtl
import pytest
from bench import pose_at
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from igtl_peers import free_port, pyigtl_server
from rclpy.exceptions import ParameterException
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image
from std_msgs.msg import Float64MultiArray

from us_sim.errors import SettingsError
from us_sim.nodes.messages import affine_message, image_message
from us_sim.nodes.openigtlink_bridge import OpenIGTLinkBridge
from us_sim.nodes.probe_tracker import ProbeTracker

MATRIX = np.array([[0.0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1]])  # mm


def scene_with(tmp_path, small_scene, tracker):
    file = tmp_path / "scene.yaml"
    file.write_text(small_scene.read_text() + tracker)
    return str(file)


def test_the_servers_poses_become_the_probes_through_all_that_happens_to_it(
    bench, tmp_path, small_scene
):
    port = free_port()
    tracker = f"""
tracker:
  source: openigtlink
  body: ProbeToTracker
  lost_after: 0.2
  coast_for: 0.1
  openigtlink: {{host: 127.0.0.1, port: {port}, clock: arrival}}
"""
    node = bench.make(ProbeTracker, scene=scene_with(tmp_path, small_scene, tracker))
    poses = bench.collect(PoseStamped, "probe/pose")
    states = bench.collect(DiagnosticStatus, "probe/status", latched=True)
    bench.spin_until(lambda: node.health.problems["connection"] > 0)
    for turn in (1, 2):
        poses.clear()
        with pyigtl_server(port) as server:
            bench.spin_until(server.is_connected)

            def arrives(server=server):
                server.send_message(pyigtl.TransformMessage(MATRIX, device_name="ProbeToTracker"))
                return len(poses) > 3

            bench.spin_until(arrives)
        for word in ("tracked", "lost"):
            bench.spin_until(
                lambda word=word, turn=turn: [s.message for s in states].count(word) >= turn
            )
    position = poses[-1].pose.position
    np.testing.assert_allclose([position.x, position.y, position.z], [0.01, 0.02, 0.03], atol=1e-8)


@pytest.mark.parametrize("reference", ["volume", "patient"])
def test_the_image_is_served_where_it_lies(bench, tmp_path, small_scene, reference):
    place = np.array([0.01, 0.0, 0.0])
    text = small_scene.read_text().replace(
        "volume: {", "volume: {pose: {position: [10 mm, 0, 0]}, "
    )
    file = tmp_path / "scene.yaml"
    file.write_text(text)
    node = bench.make(
        OpenIGTLinkBridge, scene=str(file), host="127.0.0.1", port=0, reference=reference
    )
    client = pyigtl.OpenIGTLinkClient("127.0.0.1", node.port)
    try:
        latched = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)
        latched.durability = DurabilityPolicy.TRANSIENT_LOCAL
        matrix = np.array([[2e-4, 0, 0, -0.01], [0, 0, -1, 0], [0, 2e-4, 0, 0], [0, 0, 0, 1]])
        bench.peer.create_publisher(
            Float64MultiArray, "ultrasound/image_to_probe", latched
        ).publish(affine_message(matrix))
        images = bench.publisher(Image, "ultrasound/image")
        poses = bench.publisher(PoseStamped, "probe/pose")
        bench.spin_until(lambda: "1 connected" in node.health.state)
        pixels = np.arange(12, dtype=np.uint8).reshape(3, 4)
        # The image before its pose, as it may come over another connection.
        images.publish(image_message(pixels, Time(sec=7), "probe"))
        bench.spin_for(5)
        poses.publish(pose_at(0.02, 7))
        received = {}

        def all_came():
            received.update({m.device_name: m for m in client.get_latest_messages()})
            return len(received) == 3

        bench.spin_until(all_came)
    finally:
        client.stop()
    shift = place if reference == "volume" else 0 * place
    probe = np.eye(4)
    probe[:3, 3] = [0, 0, 0.02] - shift
    to_ras = np.diag([-1.0, -1, 1, 1])
    expected = to_ras @ probe @ matrix
    image = received["Image_Reference"]
    np.testing.assert_array_equal(image.image[0], pixels)
    assert image.world_coordinate_system == "ras"
    assert image.timestamp == pytest.approx(7.0)
    for placed in (image.ijk_to_world_matrix, received["ImageToReference"].matrix):
        np.testing.assert_allclose(placed[:3, [0, 1, 3]], 1e3 * expected[:3, [0, 1, 3]], atol=1e-4)
        assert np.linalg.norm(placed[:3, 2]) == pytest.approx(0.2)
    sent = received["ProbeToReference"].matrix
    np.testing.assert_allclose(sent[:3, :3], to_ras[:3, :3], atol=1e-7)
    np.testing.assert_allclose(sent[:3, 3], 1e3 * (to_ras @ probe)[:3, 3], atol=1e-4)


@pytest.mark.parametrize(
    ("bad", "fact"),
    [
        ({"reference": "x"}, r"openigtlink_bridge\.reference: 'x' .*volume, patient"),
        ({"port": -1}, "port"),
    ],
)
def test_wrong_parameters_are_refused(bench, small_scene, bad, fact):
    with pytest.raises((SettingsError, ParameterException), match=fact):
        bench.make(OpenIGTLinkBridge, scene=str(small_scene), **bad)
