"""The layouts for RViz and Foxglove name what there is: topics of ours, and properties of theirs.

What RViz knows was read in the source of rviz 14.1.5, its branch jazzy (github.com/ros2/rviz); the
file that says it stands beside each class. Foxglove's layout was opened in Lichtblick 1.28.
"""

import json
import re
from pathlib import Path
from urllib.parse import unquote
from xml.etree import ElementTree

import pytest
import yaml

from us_sim.nodes.topics import TOPICS

CONFIG = Path(__file__).resolve().parents[1] / "config"
RVIZ = yaml.safe_load((CONFIG / "us_sim.rviz").read_text(encoding="utf-8"))
FOXGLOVE = json.loads((CONFIG / "us_sim.foxglove.json").read_text(encoding="utf-8"))
TYPES = {topic.name: topic.type_name for topic in TOPICS}
LATCHED = {topic.name for topic in TOPICS if topic.latched}

# rviz_common/include/rviz_common/ros_topic_display.hpp,
# rviz_common/src/rviz_common/properties/qos_profile_property.cpp
TOPIC = {
    "Value": str,
    "Depth": int,
    "History Policy": ("System Default", "Keep Last", "Keep All"),
    "Reliability Policy": ("System Default", "Reliable", "Best Effort"),
    "Durability Policy": ("System Default", "Transient Local", "Volatile"),
}
# rviz_common/src/rviz_common/display.cpp and display_group.cpp
DISPLAY = {"Class": str, "Name": str, "Enabled": bool, "Value": bool}
IMAGE = {  # displays/image/image_display.cpp
    "Normalize Range": bool,
    "Min Value": float,
    "Max Value": float,
    "Median window": int,
    "Topic": TOPIC,
}
# below rviz_default_plugins/src/rviz_default_plugins; the names of classes are those of
# rviz_default_plugins/plugins_description.xml
DISPLAYS = {
    "rviz_default_plugins/TF": {  # displays/tf/tf_display.cpp
        "Show Names": bool,
        "Show Axes": bool,
        "Show Arrows": bool,
        "Marker Scale": float,
        "Update Interval": float,
        "Frame Timeout": float,
    },
    "rviz_default_plugins/Marker": {"Topic": TOPIC, "Namespaces": dict},  # displays/marker
    "rviz_default_plugins/MarkerArray": {"Topic": TOPIC, "Namespaces": dict},
    "rviz_default_plugins/PointCloud2": {  # displays/pointcloud/point_cloud_common.cpp
        "Topic": TOPIC,
        "Selectable": bool,
        "Style": ("Points", "Squares", "Flat Squares", "Spheres", "Boxes", "Tiles"),
        "Size (m)": float,
        "Size (Pixels)": float,
        "Alpha": float,
        "Decay Time": float,
        # displays/pointcloud/point_cloud_transformer_factory.cpp
        "Position Transformer": ("XYZ",),
        "Color Transformer": ("RGB8", "Intensity", "AxisColor", "FlatColor", "RGBF32"),
        # displays/pointcloud/transformers/axis_color_pc_transformer.cpp
        "Axis": ("X", "Y", "Z"),
        "Autocompute Value Bounds": dict,
        "Use Fixed Frame": bool,
    },
    "rviz_default_plugins/Wrench": {  # displays/wrench/wrench_display.cpp
        "Topic": TOPIC,
        "Accept NaN Values": bool,
        "Force Color": str,
        "Torque Color": str,
        "Alpha": float,
        "Force Arrow Scale": float,
        "Torque Arrow Scale": float,
        "Arrow Width": float,
        "History Length": int,
    },
    "rviz_default_plugins/Image": IMAGE,
}
MESSAGES = {
    "rviz_default_plugins/Marker": "visualization_msgs/Marker",
    "rviz_default_plugins/MarkerArray": "visualization_msgs/MarkerArray",
    "rviz_default_plugins/PointCloud2": "sensor_msgs/PointCloud2",
    "rviz_default_plugins/Wrench": "geometry_msgs/WrenchStamped",
    "rviz_default_plugins/Image": "sensor_msgs/Image",
}
# rviz_common/src/rviz_common/panel_factory.cpp
PANELS = {
    f"rviz_common/{name}"
    for name in (
        *("Displays", "Help", "Selection", "Time", "Tool Properties", "Transformation", "Views"),
    )
}
TOOLS = {f"rviz_default_plugins/{name}" for name in ("MoveCamera", "FocusCamera", "Measure")}
ORBIT = {  # view_controllers/orbit/orbit_view_controller.cpp
    "Class": str,
    "Name": str,
    "Distance": float,
    "Focal Point": {"X": float, "Y": float, "Z": float},
    "Focal Shape Size": float,
    "Focal Shape Fixed Size": bool,
    "Yaw": float,
    "Pitch": float,
    # rviz_common/src/rviz_common/view_controller.cpp
    "Near Clip Distance": float,
    "Invert Z Axis": bool,
    # rviz_common/src/rviz_common/frame_position_tracking_view_controller.cpp
    "Target Frame": str,
}
# rviz_common/src/rviz_common/visualization_manager.cpp
OPTIONS = {"Fixed Frame": str, "Background Color": str, "Frame Rate": int}
# rviz_common/src/rviz_common/visualization_frame.cpp; it reads the two docks into a bool that it
# does not set before, so that both must be given
WINDOW = {"Width": int, "Height": int, "Hide Left Dock": bool, "Hide Right Dock": bool}


def wrong(given, known, where):
    """Sentences about keys that a class does not have, and values of another type."""
    for key, value in given.items():
        expected = known.get(key)
        if expected is None:
            yield f"{where}: there is no {key}"
        elif isinstance(expected, dict):
            yield from wrong(value, expected, f"{where}: {key}")
        elif isinstance(expected, tuple):
            if value not in expected:
                yield f"{where}: {key}: {value} is none of {expected}"
        elif expected is float:
            if isinstance(value, bool) or not isinstance(value, int | float):
                yield f"{where}: {key}: {value!r} is no number"
        elif type(value) is not expected:
            yield f"{where}: {key}: {value!r} is no {expected.__name__}"


@pytest.mark.parametrize(
    "display", RVIZ["Visualization Manager"]["Displays"], ids=lambda each: each["Name"]
)
def test_rviz_knows_each_display_and_its_properties(display):
    kind = display["Class"]
    known = DISPLAY | DISPLAYS[kind]
    assert not list(wrong(display, known, display["Name"]))
    if "Topic" in known:
        topic = display["Topic"]["Value"]
        assert TYPES[topic] == MESSAGES[kind]
        latched = display["Topic"]["Durability Policy"] == "Transient Local"
        assert latched == (topic in LATCHED)  # what was latched before RViz came would be missed


def test_rviz_draws_a_force_as_small_as_a_fingers():
    # displays/wrench: an arrow is drawn where it is longer than its width, and that is 0.5 m unless
    # it is said (rviz_rendering/src/rviz_rendering/objects/wrench_visual.cpp)
    displays = RVIZ["Visualization Manager"]["Displays"]
    (wrench,) = (each for each in displays if each["Class"].endswith("/Wrench"))
    assert 4.0 * wrench["Force Arrow Scale"] > wrench["Arrow Width"]


def test_rviz_knows_the_panels_tools_view_and_options():
    manager = RVIZ["Visualization Manager"]
    assert {panel["Class"] for panel in RVIZ["Panels"]} <= PANELS
    assert {tool["Class"] for tool in manager["Tools"]} <= TOOLS
    view = manager["Views"]["Current"]
    assert view["Class"] == "rviz_default_plugins/Orbit"
    assert not list(wrong(view, ORBIT, "view"))
    assert not list(wrong(manager["Global Options"], OPTIONS, "options"))
    assert not list(wrong(RVIZ["Window Geometry"], WINDOW, "window"))
    assert {"Hide Left Dock", "Hide Right Dock"} <= RVIZ["Window Geometry"].keys()
    assert re.fullmatch(r"\d+; \d+; \d+", manager["Global Options"]["Background Color"])


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
