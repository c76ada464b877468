"""Launch the nodes that a scene needs: ``ros2 launch us_sim us_sim.launch.py scene:=upper_arm``."""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, LogInfo, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from us_sim.errors import UsSimError
from us_sim.run.graph import player_settings
from us_sim.scene.building import path_of
from us_sim.scene.reading import load_scene
from us_sim.share import find_bag


def nodes(context):
    """One action for each node, and one line for each that is left out."""
    scene_name, path, record, volume = (
        LaunchConfiguration(name).perform(context) for name in ("scene", "path", "record", "volume")
    )
    scene = load_scene(scene_name, volume=volume or None)
    parameters = {"scene": scene.origin, "volume": scene.volume.file or ""}
    actions = []
    if record:
        file = Path(record).expanduser().resolve()
        if file.exists():
            raise UsSimError(f"{file} exists already: choose another name or remove it")
        actions.append(node("session_recorder", {"file": str(file)} | parameters))
    for part in scene.parts():
        if part.needed:
            actions.append(node(part.node, parameters))
        else:
            actions.append(LogInfo(msg=f"{part.node} is left out: {part.reason}"))
    if path:
        bag = find_bag(path)
        path_of(scene, bag)  # what is wrong with it is better said before anything starts
        actions.append(node("path_player", player_settings(scene, bag, recorded=bool(record))))
    return actions


def node(name, parameters):
    """A node of this package; when it fails, the launch fails."""

    def ended(event, context):
        if event.returncode and not context.is_shutdown:
            raise UsSimError(f"{name} ended with status {event.returncode}; see what it said above")

    return Node(
        package="us_sim",
        executable=name,
        name=name,
        parameters=[parameters],
        output="screen",
        on_exit=ended,
    )


def generate_launch_description():
    """Arguments: scene, path, record, volume."""
    arguments = {
        "scene": ("upper_arm", "scene file, or name of an installed one"),
        "path": ("", "bag with a probe path to play; empty: poses come from outside"),
        "record": ("", "MCAP file to record to; empty: nothing is recorded"),
        "volume": ("", "volume file that replaces the scene's"),
    }
    return LaunchDescription(
        [
            DeclareLaunchArgument(name, default_value=default, description=description)
            for name, (default, description) in arguments.items()
        ]
        + [OpaqueFunction(function=nodes)]
    )
