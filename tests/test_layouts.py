"""The layouts for RViz and Foxglove show topics that there are, as what they are."""

import json
import re
from pathlib import Path
from urllib.parse import unquote
from xml.etree import ElementTree

import yaml

from us_sim.nodes.topics import TOPICS

CONFIG = Path(__file__).resolve().parents[1] / "config"
RVIZ = yaml.safe_load((CONFIG / "us_sim.rviz").read_text(encoding="utf-8"))
FOXGLOVE = json.loads((CONFIG / "us_sim.foxglove.json").read_text(encoding="utf-8"))
TYPES = {topic.name: topic.type_name for topic in TOPICS}
LATCHED = {topic.name for topic in TOPICS if topic.latched}

MESSAGES = {
    "rviz_default_plugins/Marker": "visualization_msgs/Marker",
    "rviz_default_plugins/MarkerArray": "visualization_msgs/MarkerArray",
    "rviz_default_plugins/PointCloud2": "sensor_msgs/PointCloud2",
    "rviz_default_plugins/Wrench": "geometry_msgs/WrenchStamped",
    "rviz_default_plugins/Image": "sensor_msgs/Image",
}


def test_rviz_asks_for_the_types_and_for_what_is_latched():
    for display in RVIZ["Visualization Manager"]["Displays"]:
        if "Topic" in display:
            topic = display["Topic"]["Value"]
            assert TYPES[topic] == MESSAGES[display["Class"]]
            latched = display["Topic"]["Durability Policy"] == "Transient Local"
            assert latched == (topic in LATCHED)  # what was latched before it came would be missed


def test_rviz_draws_a_force_as_small_as_a_fingers():
    # displays/wrench: an arrow is drawn where it is longer than its width, and that is 0.5 m unless
    # it is said (rviz_rendering/src/rviz_rendering/objects/wrench_visual.cpp)
    displays = RVIZ["Visualization Manager"]["Displays"]
    (wrench,) = (each for each in displays if each["Class"].endswith("/Wrench"))
    assert 4.0 * wrench["Force Arrow Scale"] > wrench["Arrow Width"]


def panels_of(layout):
    """The panels that a layout of Foxglove shows, also those in tabs."""
    if isinstance(layout, str):
        tabs = FOXGLOVE["configById"][layout].get("tabs", [])
        return {layout}.union(*(panels_of(tab["layout"]) for tab in tabs))
    return panels_of(layout["first"]) | panels_of(layout["second"])


def test_foxglove_shows_every_panel_of_topics_that_there_are():
    assert panels_of(FOXGLOVE["layout"]) == FOXGLOVE["configById"].keys()
    text = json.dumps(FOXGLOVE["configById"])
    named = {name.rstrip("/") for name in re.findall(r'"/((?:[a-z_]+/)+[a-z_]+)"', text)}
    assert {"ultrasound/image_annotated", "probe/marker", "tissue/structures"} <= named
    assert named <= TYPES.keys()
    for panel, config in FOXGLOVE["configById"].items():
        for path in config.get("paths", ()):
            topic = re.match(r"/([a-z_/]+)\.", path["value"])[1]
            assert topic in TYPES, panel


def test_foxglove_sees_the_patient_with_the_skin_on_top():
    scene = FOXGLOVE["configById"]["3D!patient"]
    url = scene["layers"]["upright"]["url"]
    head, _, document = url.partition(",")
    assert head == "data:text/xml"
    (joint,) = ElementTree.fromstring(unquote(document)).iter("joint")
    assert joint.find("child").get("link") == "patient"
    assert joint.find("parent").get("link") == scene["followTf"]
    roll, pitch, yaw = map(float, joint.find("origin").get("rpy").split())
    assert (round(roll, 6), pitch, yaw) == (3.141593, 0.0, 0.0)  # half a turn about x: -z is up


def test_both_show_the_same_of_the_graph():
    displays = RVIZ["Visualization Manager"]["Displays"]
    rviz = {each["Topic"]["Value"] for each in displays if "Topic" in each}
    text = json.dumps(FOXGLOVE)
    assert {topic for topic in rviz if f'"/{topic}' not in text} == set()
