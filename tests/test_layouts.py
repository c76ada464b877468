"""The layouts for RViz and Foxglove show topics that there are, as what they are."""

import json
import re
from pathlib import Path

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
