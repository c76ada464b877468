"""Launch the nodes that a scene needs: ``ros2 launch us_sim us_sim.launch.py scene:=upper_arm``.

A node that ends or hangs is said and started again, as often as ``restarts`` allows; a launch that
lost one ends with status 1.
"""

import asyncio
import contextlib
import signal
from dataclasses import replace
from functools import partial
from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, LogInfo, OpaqueCoroutine, OpaqueFunction
from launch.events import matches_action
from launch.events.process import SignalProcess
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from us_sim.errors import UsSimError
from us_sim.run.monitored import Monitored, alone_on_domain
from us_sim.run.plan import RECORDER, Request, enclave_of, plan_of
from us_sim.run.processes import INTERRUPTED, STOP_S, ending
from us_sim.run.shared_memory import remove_abandoned_segments
from us_sim.run.supervision import going_on
from us_sim.run.watch import Restarts, SupervisionSettings, Watch
from us_sim.scene.reading import load_scene
from us_sim.settings.setting import rules_of
from us_sim.settings.viewer import ViewerSettings
from us_sim.share import find_bag

LOOK_S = 0.1
COMPILES = {"sigterm_timeout": "2", "sigkill_timeout": "1"}
"""s after Ctrl-C; a node that compiles hears no signal, and only the recorder has what to keep."""
ARGUMENTS = {
    "scene": ("upper_arm", "scene file, or name of an installed one"),
    "path": ("", "bag with a probe path to play; empty: poses come from outside"),
    "record": ("", "MCAP file to record to; empty: nothing is recorded"),
    "volume": ("", "volume file that replaces the scene's"),
    "composed": ("false", "true: the scene's nodes are in one process"),
    "view": (
        "false",
        "true: a page in a browser shows the simulation, and moves the probe where no path is "
        "played",
    ),
}
SUPERVISION = {
    name: (str(getattr(SupervisionSettings(), name)), rule.description)
    for name, rule in rules_of(SupervisionSettings).items()
}


def session(context):
    """The nodes of a scene, what watches them, and one line for each that is left out."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    settings = SupervisionSettings(
        **{name: LaunchConfiguration(name).perform(context) for name in SUPERVISION}
    )
    scene = load_scene(given["scene"], volume=given["volume"] or None)
    record = Path(given["record"]).expanduser().resolve() if given["record"] else None
    if record is not None and record.exists():
        raise UsSimError(f"{record} exists already: choose another name or remove it")
    path = find_bag(given["path"]) if given["path"] else None
    for name in ("view", "composed"):
        if given[name] not in ("true", "false"):
            raise UsSimError(f"{name}:={given[name]}: must be true or false")
    view = ViewerSettings() if given["view"] == "true" else None
    by_hand = view is not None and path is None
    request = Request(scene, record=record, path=path, view=view, by_hand=by_hand)
    plan = plan_of(replace(request, composed=given["composed"] == "true"))
    supervised = Supervised(plan, settings, context.launch_configurations.get("ros_namespace", ""))
    left_out = [part for part in scene.parts() if not part.needed]
    return [
        *(LogInfo(msg=f"{part.node} is left out: {part.reason}") for part in left_out),
        *(supervised.action(process) for process in plan.processes),
        OpaqueCoroutine(coroutine=supervised.watch),
    ]


class Supervised:
    """Nodes that are started again when they end or hang."""

    def __init__(self, plan, settings, namespace):
        self.player = plan.player if plan.poses is not None else ""
        self.processes = {process.node: process for process in plan.processes}
        self.parts = {each.node: [part.node for part in each.parts] for each in plan.processes}
        self.restarts, self.hang = Restarts(settings), Watch(settings.silence)
        self.actions = {}  # that run, by node
        self.why = {}  # nodes are made to end, by node
        self.lost = []
        self.resources = contextlib.ExitStack()
        self.resources.enter_context(alone_on_domain(namespace))
        self.monitor = Monitored(plan.nodes, namespace=namespace)
        self.resources.callback(remove_abandoned_segments)
        self.resources.callback(self.monitor.close)
        self.monitor.refuse_company(plan.nodes)

    def action(self, process):
        """What starts a node."""
        self.actions[process.node] = Node(
            package="us_sim",
            executable=process.node,
            # A rule for the name of a process is one for all nodes in it.
            name=None if process.parts else process.node,
            parameters=[process.all_parameters],
            ros_arguments=["--enclave", enclave_of(process.node), *process.arguments_of_parts()],
            output="screen",
            on_exit=partial(self.ended, process.node),
            **({} if process.node == RECORDER else COMPILES),
        )
        return self.actions[process.node]

    def ended(self, node, event, context):
        """Start it again, unless it has done its work, the launch ends, or it cannot work."""
        del self.actions[node]
        if context.is_shutdown or (node == self.player and not event.returncode):
            return None
        report = self.monitor.node.reports.get(node, {})
        if not report and event.returncode > 0 and event.returncode != INTERRUPTED:
            raise UsSimError(f"{node} {ending(event.returncode)}; see what it said above")
        refused = self.restarts.refused(node)
        what = f"{node} {self.why.pop(node, ending(event.returncode))}"
        self.lost.append(f"{what} and {refused or 'was started again'}")
        self.monitor.node.tell_lost(self.lost)
        if refused:
            return [LogInfo(msg=f"{what} and {refused}")]
        own = report.get("pid") == str(event.pid)
        again = going_on(self.processes[node], report if own else {})
        return [LogInfo(msg=f"{what}; it is started again"), self.action(again)]

    async def watch(self, context):
        """End those that hang, until nothing runs any more; raise UsSimError when any was lost."""
        try:
            with self.resources:
                while self.actions:
                    await asyncio.sleep(LOOK_S)
                    for _ in range(2 * len(self.processes)):
                        self.monitor.spin(0.0)
                    pids = {
                        node: action.process_details["pid"]
                        for node, action in self.actions.items()
                        if "pid" in (action.process_details or {})
                    }
                    heard = self.monitor.node.heard
                    for node, how in self.hang.hung(pids, heard, self.parts).items():
                        self.why[node] = how
                        await self.end(self.actions[node], context)
        except asyncio.CancelledError:
            pass  # the launch ends
        if self.lost:
            raise UsSimError("; ".join(self.lost))

    async def end(self, action, context):
        """Let one that hangs end by itself for a moment, then end it."""
        for number in (signal.SIGTERM, signal.SIGCONT):
            await self.send(action, number, context)
        for _ in range(round(STOP_S / LOOK_S)):
            if action in self.actions.values():
                await asyncio.sleep(LOOK_S)
        await self.send(action, signal.SIGKILL, context)

    async def send(self, action, number, context):
        if action in self.actions.values():
            event = SignalProcess(signal_number=number, process_matcher=matches_action(action))
            await context.emit_event(event)


def generate_launch_description():
    """Arguments: scene, path, record, volume, view, and what is done for nodes that end or hang."""
    return LaunchDescription(
        [
            DeclareLaunchArgument(name, default_value=default, description=description)
            for name, (default, description) in {**ARGUMENTS, **SUPERVISION}.items()
        ]
        + [OpaqueFunction(function=session)]
    )
