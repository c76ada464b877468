"""The recorder: every topic as soon as it appears, readable at every moment."""

import numpy as np
import pytest
from bench import pose_at
from geometry_msgs.msg import PoseStamped
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.interfaces import QosDurability, QosReliability
from sensor_msgs.msg import Image
from std_msgs.msg import String

from us_sim.nodes.messages import image_message
from us_sim.nodes.session_recorder import SessionRecorder
from us_sim.nodes.slice_interpolator import SliceInterpolator
from us_sim.recording.reader import read_bag


def test_what_is_published_is_recorded_as_it_was(bench, tmp_path):
    file = tmp_path / "session.mcap"
    recorder = bench.make(SessionRecorder, file=str(file), exclude=["/diagnostics"])
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    bench.peer.create_publisher(String, "early", latched).publish(String(data="before"))
    best_effort = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    images = bench.peer.create_publisher(Image, "ultrasound/image", best_effort)
    poses = bench.publisher(PoseStamped, "tracker/pose")
    bench.spin_until(lambda: images.get_subscription_count() > 0)
    sent = [pose_at(0.001 * k, 1 + k) for k in range(200)]
    for pose in sent:
        poses.publish(pose)
    pixels = np.arange(12, dtype=np.uint8).reshape(3, 4)
    images.publish(image_message(pixels, sent[0].header.stamp, "probe"))
    bench.spin_until(lambda: recorder.health.received >= 202)
    bench.spin_until(lambda: read_bag(file).message_count >= 202)  # while it is still open
    bench.executor.remove_node(recorder)
    recorder.destroy_node()
    bag = read_bag(file)
    assert not bag.fault
    messages = list(bag.read_messages(["/tracker/pose"]))
    assert [deserialize_message(bytes(m.data), PoseStamped) for m in messages] == sent
    assert {len(m.data) for m in messages} == {len(serialize_message(sent[0]))}
    assert bag.find_topic("/early").message_count == 1
    assert bag.find_topic("/early").qos[0].durability == QosDurability.TRANSIENT_LOCAL
    assert bag.find_topic("/ultrasound/image").qos[0].reliability == QosReliability.BEST_EFFORT
    for message in bag.read_messages():
        assert message.publish_time <= message.log_time


def test_topics_can_be_chosen_and_left_out(bench, tmp_path):
    chosen = bench.make(SessionRecorder, file=str(tmp_path / "a.mcap"), topics=["/wanted"])
    publishers = [bench.peer.create_publisher(String, name, 10) for name in ("wanted", "other")]
    bench.spin_until(lambda: publishers[0].get_subscription_count() > 0)
    bench.spin_for(30)
    assert publishers[1].get_subscription_count() == 0
    bench.executor.remove_node(chosen)
    chosen.destroy_node()
    assert [topic.name for topic in read_bag(tmp_path / "a.mcap").topics] == ["/wanted"]


def test_what_is_made_on_demand_is_recorded_beside_all_others(bench, tmp_path):
    names = ("tissue/structures", "tissue/nodes", "ultrasound/image_annotated")
    structures, nodes, annotated = (bench.peer.create_publisher(String, name, 10) for name in names)
    file = str(tmp_path / "more.mcap")
    bench.make(SessionRecorder, file=file, also=["/tissue/structures"])
    bench.spin_until(
        lambda: structures.get_subscription_count() > 0 and nodes.get_subscription_count() > 0
    )
    bench.spin_for(30)
    assert annotated.get_subscription_count() == 0


@pytest.mark.slow
def test_each_simulator_on_a_domain_is_recorded_alone(bench, tmp_path, small_scene):
    def start(kind, space, **parameters):
        overrides = [Parameter(name, value=value) for name, value in parameters.items()]
        node = kind(namespace=space, context=bench.context, parameter_overrides=overrides)
        return bench.add(node)

    scene = tmp_path / "bare.yaml"  # an image for every pose, and others on demand
    scene.write_text(small_scene.read_text().partition("tissue:")[0])
    images, files, recorders, poses = [], {}, {}, {}
    more = {"/a": {"also": ["ultrasound/labels", "/b/probe/pose"]}, "/b": {}, "/": {}}
    for space, extra in more.items():
        slicer = start(SliceInterpolator, space, scene=str(scene))
        images += [each for each in slicer.publishers if each.msg_type is Image]
        files[space] = tmp_path / f"of_{space[1:]}" / "session.mcap"
        files[space].parent.mkdir()
        file = str(files[space])
        recorders[space] = start(SessionRecorder, space, file=file, **extra)
        name = slicer.resolve_topic_name("probe/pose")
        poses[space] = bench.peer.create_publisher(PoseStamped, name, 10)
    foreign = [bench.peer.create_publisher(String, name, 10) for name in ("/tf", "/driver/state")]
    # slicer and recorder; of /b that of /a, too
    bench.spin_until(lambda: [poses[each].get_subscription_count() for each in more] == [2, 3, 2])
    bench.spin_until(lambda: [each.get_subscription_count() for each in foreign] == [3, 1])
    for publisher in poses.values():
        publisher.publish(pose_at(0.001, 1))
    bench.spin_until(lambda: all(read_bag(each).message_count > 3 for each in files.values()))
    heard = {each.topic_name for each in images if each.get_subscription_count() > 0}
    recorded = {}
    for space, recorder in recorders.items():
        bench.executor.remove_node(recorder)
        recorder.destroy_node()
        recorded[space] = {topic.name for topic in read_bag(files[space]).topics}
    own = ("diagnostics", "probe/pose", "ultrasound/image", "ultrasound/image_to_probe")
    assert recorded == {
        "/a": {f"/a/{name}" for name in (*own, "ultrasound/labels")} | {"/b/probe/pose", "/tf"},
        "/b": {f"/b/{name}" for name in own} | {"/tf"},
        "/": {f"/{name}" for name in own} | {"/tf", "/driver/state"},
    }
    ordered = "/a/ultrasound/labels"
    assert heard == {ordered} | {f"{space}/ultrasound/image" for space in ("", "/a", "/b")}
