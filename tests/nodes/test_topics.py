"""The table of topics is what the nodes publish and hear: no topic more, none less."""

import ast
import shutil
from importlib import import_module
from pathlib import Path

import pytest
from bench import Bench
from rclpy.qos import DurabilityPolicy

from us_sim import viewer
from us_sim.nodes.camera_driver import CameraDriver
from us_sim.nodes.haptic_renderer import HapticRenderer
from us_sim.nodes.image_writer import ImageWriter
from us_sim.nodes.messages import TFMessage
from us_sim.nodes.openigtlink_bridge import OpenIGTLinkBridge
from us_sim.nodes.path_player import PathPlayer
from us_sim.nodes.probe_robot import ProbeRobot
from us_sim.nodes.probe_tracker import ProbeTracker
from us_sim.nodes.session_monitor import SessionMonitor
from us_sim.nodes.session_player import SessionPlayer
from us_sim.nodes.session_recorder import SessionRecorder
from us_sim.nodes.settings import NODES
from us_sim.nodes.skin_deformer import SkinDeformer
from us_sim.nodes.slice_interpolator import SliceInterpolator
from us_sim.nodes.space_mouse_driver import SpaceMouseDriver
from us_sim.nodes.tissue_deformer import TissueDeformer
from us_sim.nodes.topics import TOPICS
from us_sim.settings.registry import TRACKERS
from us_sim.share import shared_path

ROS_OWN = {"/rosout", "/parameter_events", "/clock"}
TRACKER_KEYS = {
    "tf": "frame: world, body: stylus",
    "path": f"file: {Path(shared_path('bags/press_and_slide.mcap'))}",
    "openigtlink": "frame: camera, body: stylus, openigtlink: {port: 1}",
}


@pytest.fixture
def scenes(tmp_path, small_scene):
    def scene(source):
        file = tmp_path / f"{source}.yaml"
        keys = TRACKER_KEYS.get(source)
        file.write_text(
            small_scene.read_text()
            + "imaging: {contact: true}  # so that images ask for the skin\n"
            + "structures: {vein: {flow: {kind: venous, direction: [0, 1, 0], "
            + "peak_velocity: 0.2, mean_velocity: 0.07}}}\n"
            + f"tracker: {{source: {source}{', ' + keys if keys else ''}}}\n"
        )
        return str(file)

    return scene


def endpoints_of(node):
    """Topic, type, latched or not, and direction of each endpoint of a node."""
    namespace = node.get_namespace()
    for direction, endpoints in (("from", node.publishers), ("to", node.subscriptions)):
        for endpoint in endpoints:
            if endpoint.topic_name in ROS_OWN:
                continue
            package = endpoint.msg_type.__module__.partition(".")[0]
            latched = endpoint.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
            yield (
                endpoint.topic_name.removeprefix(namespace).lstrip("/"),
                f"{package}/{endpoint.msg_type.__name__}",
                latched,
                direction,
                node.get_name(),
            )


def told(nodes):
    return {
        (topic.name, topic.type_name, topic.latched, direction, node)
        for topic in TOPICS
        for direction, names in (("from", topic.publishers), ("to", topic.subscribers))
        for node in names
        if node in nodes and is_there(topic.type_name)
    }


def is_there(type_name):
    """Whether there is such a type: tf2_msgs may be missing."""
    package, name = type_name.split("/")
    try:
        return hasattr(import_module(f"{package}.msg"), name)
    except ImportError:
        return False


def test_the_probe_tracker_hears_what_each_source_needs(bench, scenes):
    found = set()
    for source in TRACKERS if TFMessage else set(TRACKERS) - {"tf"}:
        found |= set(endpoints_of(bench.make(ProbeTracker, scene=scenes(source))))
    assert found == told({"probe_tracker"})


def test_the_nodes_of_a_scene_publish_and_hear_what_the_table_says(bench, scenes):
    scene = scenes("haptic")
    nodes = [
        bench.make(kind, scene=scene)
        for kind in (TissueDeformer, SkinDeformer, SliceInterpolator, HapticRenderer)
    ]
    nodes.append(bench.make(OpenIGTLinkBridge, scene=scene, port=0))
    found = {endpoint for node in nodes for endpoint in endpoints_of(node)}
    assert found == told({node.get_name() for node in nodes})


def test_players_drivers_and_writers_do_too(bench, tmp_path):
    bag = str(shared_path("bags/press_and_slide.mcap"))
    nodes = [
        bench.make(PathPlayer, path=bag, lockstep=True),
        bench.make(
            ImageWriter,
            folder=str(tmp_path / "images"),
            labels=str(tmp_path / "labels"),
            displacement=str(tmp_path / "displacement"),
        ),
        bench.make(CameraDriver, source="/dev/no_camera"),
        bench.make(SpaceMouseDriver),
        bench.make(ProbeRobot),
        bench.add(SessionMonitor(context=bench.context)),
    ]
    found = {endpoint for node in nodes for endpoint in endpoints_of(node)}
    assert found == told({node.get_name() for node in nodes})


def test_what_records_and_plays_every_topic_reports_too(bench, tmp_path):
    bag = tmp_path / "bag.mcap"
    shutil.copy(shared_path("bags/press_and_slide.mcap"), bag)
    player = bench.make(SessionPlayer, path=str(bag))
    recorder = bench.make(SessionRecorder, file=str(tmp_path / "session.mcap"), topics=["/none"])
    played = {endpoint for endpoint in endpoints_of(player) if endpoint[0] != "tracker/pose"}
    assert played | set(endpoints_of(recorder)) == told({"session_player", "session_recorder"})


@pytest.fixture
def all_nodes(scenes, tmp_path):
    def make(bench):
        scene = scenes("pose")
        bag = tmp_path / "bag.mcap"
        shutil.copy(shared_path("bags/press_and_slide.mcap"), bag)
        kinds = (ProbeTracker, TissueDeformer, SkinDeformer, SliceInterpolator, HapticRenderer)
        nodes = [bench.make(kind, scene=scene) for kind in kinds]
        return [
            *nodes,
            bench.make(PathPlayer, path=str(bag), lockstep=True, clock=1.0),
            bench.make(SessionPlayer, path=str(bag)),
            bench.make(SessionRecorder, file=str(tmp_path / "a.mcap"), topics=["/none"]),
            bench.make(OpenIGTLinkBridge, scene=scene, port=0),
            bench.make(CameraDriver, source="/dev/no_camera"),
            bench.make(SpaceMouseDriver),
            bench.make(ProbeRobot),
            bench.add(SessionMonitor(context=bench.context)),
        ]

    return make


def test_every_topic_has_overrides_of_its_quality_of_service(bench, all_nodes):
    for node in all_nodes(bench):
        for direction, endpoints in (
            ("publisher", node.publishers),
            ("subscription", node.subscriptions),
        ):
            for topic in {each.topic_name for each in endpoints} - ROS_OWN:
                for policy in ("reliability", "history", "depth"):
                    name = f"qos_overrides.{topic}.{direction}.{policy}"
                    assert node.has_parameter(name), (node.get_name(), name)


def test_every_topic_can_be_remapped_and_is_in_the_namespace(all_nodes):
    moved = [f"{topic.name}:=moved/{topic.name}" for topic in TOPICS]
    rules = [word for rule in ("__ns:=/left", *moved) for word in ("-r", rule)]
    bench = Bench(["--ros-args", *rules])
    try:
        for node in all_nodes(bench):
            names = {each.topic_name for each in (*node.publishers, *node.subscriptions)}
            if node.get_name() == "session_player":
                names.discard("/tracker/pose")  # as it is called in the bag
            assert names - ROS_OWN
            for name in names - ROS_OWN:
                assert name.startswith("/left/moved/"), (node.get_name(), name)
    finally:
        bench.close()


def test_the_viewer_names_the_topics_that_it_hears():
    """It hears most of them only while a page is open."""
    names = {topic.name for topic in TOPICS}
    constants = {
        node.value
        for file in Path(viewer.__file__).parent.glob("*.py")
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    assert names & constants == {topic.name for topic in TOPICS if "viewer" in topic.subscribers}


def test_every_node_is_in_the_table_and_no_other():
    named = {node for topic in TOPICS for node in (*topic.publishers, *topic.subscribers)}
    assert named == set(NODES) | {"session_monitor"}
    assert len({topic.name for topic in TOPICS}) == len(TOPICS)
