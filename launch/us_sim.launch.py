"""Launch the nodes that a scene needs: ``ros2 launch us_sim us_sim.launch.py scene:=upper_arm``.

A node that ends is started again by launch, at most ``restarts`` times.
"""

import contextlib
from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, LogInfo, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from us_sim.errors import UsSimError
from us_sim.nodes.settings import RECORDER
from us_sim.run.domain import lock_domain, name_enclave
from us_sim.run.plan import RunRequest, make_plan, require_new
from us_sim.scene.reading import load_scene
from us_sim.settings.viewer import ViewerSettings
from us_sim.share import find_bag

COMPILES = {"sigterm_timeout": "2", "sigkill_timeout": "1"}
"""s after Ctrl-C; a node that compiles hears no signal, and only the recorder has what to keep."""
ARGUMENTS = {
    "scene": ("upper_arm", "scene file, or name of an installed one"),
    "path": ("", "bag with a probe path to play; empty: poses come from outside"),
    "record": ("", "MCAP file to record to; empty: nothing is recorded"),
    "volume": ("", "volume file that replaces the scene's"),
    "view": (
        "false",
        "true: a page in a browser shows the simulation, and moves the probe where no path is "
        "played",
    ),
    "restarts": ("10", "start a node that has ended again, at most so often"),
}
held = contextlib.ExitStack()  # the domain's lock, until the launch's process ends


def start_session(context):
    """Start the nodes of a scene, and print one line for each that is left out."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    scene = load_scene(given["scene"], volume=given["volume"] or None)
    record = Path(given["record"]).expanduser().resolve() if given["record"] else None
    if record is not None:
        require_new(record)
    path = find_bag(given["path"]) if given["path"] else None
    if given["view"] not in ("true", "false"):
        raise UsSimError(f"view:={given['view']}: must be true or false")
    if not given["restarts"].isdecimal():
        raise UsSimError(f"restarts:={given['restarts']}: must be a number of restarts")
    view = ViewerSettings() if given["view"] == "true" else None
    by_hand = view is not None and path is None
    plan = make_plan(RunRequest(scene, record=record, path=path, view=view, by_hand=by_hand))
    held.enter_context(lock_domain(context.launch_configurations.get("ros_namespace", "")))
    left_out = [part for part in scene.list_parts() if not part.needed]
    return [
        *(LogInfo(msg=f"{part.node} is left out: {part.reason}") for part in left_out),
        *(
            create_action(process, 0 if process.node == plan.player else int(given["restarts"]))
            for process in plan.processes
        ),
    ]


def create_action(process, restarts):
    """Return what starts a node, and starts it again so often."""
    further = {"if_exists": "further"} if process.node == RECORDER else {}
    return Node(
        package="us_sim",
        executable=process.node,
        name=process.node,
        parameters=[process.parameters | further],
        ros_arguments=["--enclave", name_enclave(process.node)],
        output="screen",
        respawn=restarts > 0,
        respawn_delay=0.5,
        respawn_max_retries=restarts,
        **({} if further else COMPILES),
    )


def generate_launch_description():
    """Arguments: scene, path, record, volume, view, and how often a node is started again."""
    return LaunchDescription(
        [
            DeclareLaunchArgument(name, default_value=default, description=description)
            for name, (default, description) in ARGUMENTS.items()
        ]
        + [OpaqueFunction(function=start_session)]
    )
