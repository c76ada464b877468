"""Node processes watched and started again, and what was lost meanwhile.

A `Supervisor` keeps the nodes of a plan running: one that ends, or that says nothing on
``diagnostics`` for too long, is started again.
"""

from __future__ import annotations

import contextlib
import re
import shutil
import sys
import time
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from us_sim.errors import BagError, UsSimError, printable
from us_sim.nodes import INTERRUPTED
from us_sim.nodes.settings import RECORDER, VIEWER
from us_sim.run.domain import domain, namespace, ros_context
from us_sim.run.plan import NodeProcess, Plan, goes_on, recorder_of
from us_sim.run.processes import ProcessGroup, ending
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting
from us_sim.settings.spelling import counted

if TYPE_CHECKING:
    from us_sim.nodes.session_control import Controlled, SessionControl
    from us_sim.nodes.session_monitor import SessionMonitor
    from us_sim.nodes.settings import SessionControlSettings

IMAGES, IMAGER = "ultrasound/image", "slice_interpolator"
DISCOVERY_S = 0.4  # to discover whether another simulation is on this ROS domain
START_S = 900.0  # for the first report: a first run compiles for minutes
STEP_S = 0.5
"""A longer time between two looks counts as this much: this process was stopped or had no time."""
TOLD = 4  # losses that are told one by one in a sentence


@dataclass(frozen=True)
class SupervisionSettings(Settings):
    """Settings of restarts of nodes that have ended or hang."""

    restarts: int = setting(
        Quantity("number", 0, 1_000_000),
        "start a node that ended or hangs again, at most so often",
        default=10,
    )
    silence: float = setting(
        Quantity("time", 2.0, 3600.0),
        "seconds without a report after which a node hangs",
        default=30.0,
    )


@dataclass
class Loss:
    """A node that ended or hung, and its restart."""

    node: str
    what: str  # it did: "was ended by SIGKILL"
    at_s: float  # since the nodes were started
    last_words: str = ""  # of the node
    back_after_s: float | None = None  # until it reported again
    given_up: str = ""  # why it was not started again
    time: str = field(default_factory=lambda: datetime.now().astimezone().isoformat())

    def __str__(self) -> str:
        """For a person."""
        then = f" and {self.given_up}" if self.given_up else ""
        if self.back_after_s is not None:
            then = f" and was back after {self.back_after_s:.1f} s"
        return f"{self.node} {self.what} at {self.at_s:.1f} s{then}"


@dataclass(frozen=True)
class Outcome:
    """How a run went."""

    startup: float  # s until all nodes were ready
    losses: Sequence[Loss]
    files: Sequence[Path]  # recorded, in their order
    made: int  # images, that the node which makes them has reported
    recorded: int  # of them
    poses: int | None  # that there were to play
    awaited: str = ""  # why nothing was played

    def sentence(self) -> str:
        """Return the losses, for a person; nothing when there are none."""
        lacks_images = bool(self.files) and self.recorded < self.made
        if not (self.losses or self.awaited or lacks_images):
            return ""
        told = [str(loss) for loss in self.losses[:TOLD]]
        if len(self.losses) > TOLD:
            told.append(f"and {len(self.losses) - TOLD} more times nodes ended or hung")
        if self.awaited:
            told.append(f"nothing was played: it waited for {self.awaited}")
        if lacks_images:
            told.append(f"{self.recorded} images were recorded of {self.made} that were made")
        elif self.files and self.losses:
            of = f" of {self.poses} poses" if self.poses is not None else ""
            told.append(f"{self.recorded} images were recorded{of}")
        if self.files:
            told.append(f"the recording is in {', '.join(file.name for file in self.files)}")
        return "; ".join(told)

    def summary(self) -> dict[str, Any]:
        """Return the losses as one JSON-like mapping."""
        return {
            "nodes": [asdict(loss) for loss in self.losses],
            "images_made": self.made,
            "images_recorded": self.recorded,
            "files": [file.name for file in self.files],
        }


class Recordings:
    """Finds the files of each recorder that was started, without those that were there before."""

    def __init__(self) -> None:
        # By the file asked for: those that were there, and when it was begun (s, monotonic).
        self._begun: dict[Path, tuple[set[Path], float]] = {}

    def begin(self, recorder: NodeProcess) -> None:
        """Note that a recorder is about to be started."""
        file = Path(str(recorder.parameters["file"]))
        self._begun.setdefault(file, (set(files_of(file)), time.monotonic()))

    def progress(self, file: Path) -> dict[str, str]:
        """Return age and size of a recording and the room that is left, as in diagnostics."""
        try:
            begun = self._begun[file][1]
            size = sum(each.stat().st_size for each in self._files(file))
            room = shutil.disk_usage(file.parent).free
        except (KeyError, OSError):  # not begun, or its folder is gone: the recorder says so
            return {}
        return {
            "record_seconds": f"{time.monotonic() - begun:.0f}",
            "record_bytes": str(size),
            "record_room_bytes": str(room),
        }

    def files(self) -> list[Path]:
        """Return the files that are there by now, in the order in which they were begun."""
        return [found for file in self._begun for found in self._files(file)]

    def _files(self, file: Path) -> list[Path]:
        return [found for found in files_of(file) if found not in self._begun[file][0]]


def files_of(recording: Path) -> list[Path]:
    """Return a recording's file and those in which it goes on: ``a.mcap``, ``a_1.mcap``, …"""
    pattern = re.compile(rf"{re.escape(recording.stem)}((?:_\d+)*){re.escape(recording.suffix)}")
    found = {file: pattern.fullmatch(file.name) for file in recording.parent.glob("*")}
    numbers = {file: [*map(int, match[1].split("_")[1:])] for file, match in found.items() if match}
    return sorted(numbers, key=numbers.__getitem__)


def images_in(files: Sequence[Path], name: str) -> int:
    """Count the images on a topic in recordings; a file that cannot be read has none."""
    from us_sim.recording.reader import read_bag  # takes long to import, and starts need it not

    count = 0
    for file in files:
        with contextlib.suppress(BagError):
            topics = read_bag(file).topics
            count += sum(topic.message_count for topic in topics if topic.name == name)
    return count


class Monitored:
    """A monitor node in this process, with its own context and executor.

    Args:
        nodes: that are followed.
    """

    def __init__(self, nodes: list[str]) -> None:
        from rclpy.executors import SingleThreadedExecutor

        from us_sim.nodes.session_monitor import SessionMonitor

        self._context = ros_context()
        self.node: SessionMonitor = SessionMonitor(nodes, context=self._context)
        self._executor: Any = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)

    def control(self, controlled: Controlled, settings: SessionControlSettings) -> SessionControl:
        """Make the node by which a simulation with these settings is controlled."""
        from us_sim.nodes.session_control import SessionControl

        control = SessionControl(controlled, settings, context=self._context)
        self._executor.add_node(control)
        return control

    def spin(self, seconds: float = 0.1) -> None:
        """Take the next message, waiting at most so long."""
        self._executor.spin_once(timeout_sec=seconds)

    def refuse_company(self, names: Collection[str]) -> None:
        """Raise UsSimError when a node of one of these names is on the domain already."""
        until = time.monotonic() + DISCOVERY_S
        while time.monotonic() < until:
            self.spin()
        own = self.node.get_namespace()
        there = {name for name, space in self.node.get_node_names_and_namespaces() if space == own}
        if taken := sorted(set(names) & there):
            raise UsSimError(
                f"{taken[0]} runs already on ROS domain {domain()}: "
                f"end that simulation, or set ROS_DOMAIN_ID to another number for this one"
            )

    def close(self) -> None:
        """Leave the domain."""
        nodes = self._executor.get_nodes()
        self._executor.shutdown()
        for node in nodes:
            node.destroy_node()
        self._context.try_shutdown()


class Supervisor:
    """Keeps the nodes of a plan running: one that ends or hangs is started again.

    Another plan may take its place while it runs. What is noticed is said, kept in `losses`, and
    published on ``diagnostics``, so that it is in the recording.

    Args:
        plan: what runs.
        group: of the processes.
        monitor: hears what they report.
        settings: when a node hangs, and how often it is started again.
    """

    def __init__(
        self, plan: Plan, group: ProcessGroup, monitor: Monitored, settings: SupervisionSettings
    ) -> None:
        self.plan = plan
        self.losses: list[Loss] = []
        self.recordings = Recordings()
        self.finished = False  # whether what is played is at its end, or given up
        self._group, self._monitor, self._settings = group, monitor, settings
        self._heard: dict[tuple[str, int], tuple[int, float]] = {}  # reports, time of the last
        self._looked, self._watched = time.monotonic(), 0.0  # s
        self._away: dict[str, Loss] = {}  # that are being started again
        self._were_ready: set[str] = set()
        self._processes: dict[str, NodeProcess] = {}  # that were started, by node
        self._images = monitor.node.resolve_topic_name(IMAGES)  # also once the node has ended
        self._began = time.monotonic()
        self._changes = 0
        self._is_disk_full = False
        self.change(plan)

    def change(self, plan: Plan, anew: Collection[str] = ()) -> None:
        """Run this plan; processes that the plan before had, too, go on.

        Args:
            plan: what runs from now on.
            anew: nodes that do not go on even so.
        """
        wanted = {process.node: process for process in plan.processes}
        over = {
            node
            for node, process in self._processes.items()
            if node in anew or not goes_on(process, wanted.get(node))
        }
        if over:  # before others of the same names are started
            self._note_killed(self._group.end(over))
        for node in over:
            self._away.pop(node, None)
        self._were_ready -= over
        self.plan, self.finished = plan, False
        self._restarts: Counter[str] = Counter()
        self._changes += 1
        self._monitor.node.follow(plan.nodes)
        new = over | wanted.keys() - self._processes.keys()
        self._processes = wanted
        if RECORDER in wanted:
            self.recordings.begin(wanted[RECORDER])
        self._group.start(each for each in plan.processes if each.node in new)

    @property
    def waiting(self) -> list[str]:
        """Nodes that have not reported yet, or not yet again."""
        heard = self._monitor.node.heard
        return [
            node
            for node, pid in self._group.pids.items()
            if node in self._processes and (node, pid) not in heard
        ]

    def failed(self) -> str:
        """Return why the plan cannot run, where a node is given up before all were ready."""
        late = self.waiting
        given_up = (loss for loss in self.losses if loss.given_up and loss.node in late)
        return str(next(given_up, ""))

    def update(self) -> None:
        """Take new reports, and restart nodes that have ended or hang.

        Raises:
            UsSimError: a node that was never ready cannot work, in its own words.
        """
        self._monitor.spin()
        ended = self._group.take_ended()
        for _ in range(2 * len(self._processes) if ended else 0):
            self._monitor.spin(0.0)  # what they said last
        for node, status in ended.items():
            self._on_ended(node, status)
        self._end_silent()
        self._note_ready()
        self._note_full_disk()

    def end(self) -> None:
        """End all nodes; a recorder that had to be killed is lost, as is who is not back."""
        for loss in self._away.values():
            loss.given_up = "was not back when the run ended"
        self._note_killed(self._group.stop())

    def outcome(self, startup: float) -> Outcome:
        """Return how it went, once all has ended."""
        files = self.recordings.files()
        recorded = images_in(files, self._images)
        # How many images were to be recorded is only known where all that were made were.
        recorder = recorder_of(self.plan.processes)
        all_were = recorder and recorder.at_once and recorder.records(self._images, namespace())
        is_known = all_were and self._changes == 1
        made = self._monitor.node.count(IMAGER, IMAGES) if is_known else recorded
        poses = None if self.plan.loops else self.plan.poses
        awaited = self._monitor.node.reports.get(self.plan.player, {}).get("awaited", "")
        return Outcome(startup, self.losses, files, made, recorded, poses, awaited)

    def _note_killed(self, killed: Collection[str]) -> None:
        if RECORDER in killed:
            what = "did not end when it was told to and was killed"
            self._note(RECORDER, what, given_up="its last messages may be missing")

    def _on_ended(self, node: str, status: int) -> None:
        plays = self.plan.poses is not None and node == self.plan.player
        if plays and status == 0:  # it has another where it was told to end before
            self.finished = True
            return
        if status > 0 and status != INTERRUPTED and node not in self._were_ready:
            raise self._group.failure(node, status)
        self._on_lost(node, ending(status), self._group.last_words(node))

    def _end_silent(self) -> None:
        """End nodes that have not reported for too long, and start them again."""
        now = time.monotonic()
        self._watched += min(now - self._looked, STEP_S)
        self._looked = now
        for node, pid in [*self._group.pids.items()]:
            if not self._group.is_running(node):
                continue
            count = self._monitor.node.heard[node, pid]
            before, since = self._heard.get((node, pid), (-1, 0.0))
            silent = self._watched - since
            if count != before:
                self._heard[node, pid] = count, self._watched
            elif silent > (self._settings.silence if count else START_S):
                if node not in self._were_ready:
                    raise UsSimError(f"{node} did not start in {START_S / 60:g} minutes")
                said = self._monitor.node.messages.get(node) or self._group.last_words(node)
                self._group.end([node])
                self._on_lost(node, f"has not reported for {silent:.0f} s", said)

    def _on_lost(self, node: str, what: str, said: str) -> None:
        """Note a node's end, and start it again with the values that it was first started with."""
        limit, given_up = self._settings.restarts, ""
        if self._restarts[node] >= limit:
            given_up = f"is not started again after {counted(limit, 'restart')}"
        loss = self._note(node, what, said, given_up, "it is started again")
        self._publish()
        self._restarts[node] += 1
        if given_up:
            self._away.pop(node, None)
            self.finished |= node == self.plan.player
            return
        report = self._monitor.node.reports.get(node, {})
        is_own = report.get("pid") == str(self._group.pids[node])
        self._group.start([going_on(self._processes[node], report if is_own else {})])
        self._away[node] = loss

    def _note_ready(self) -> None:
        waiting = self.waiting
        self._were_ready |= self._processes.keys() - set(waiting)
        for node in [node for node in self._away if node not in waiting]:
            loss = self._away.pop(node)
            loss.back_after_s = round(time.monotonic() - self._began - loss.at_s, 2)
            self._publish()
            say(f"{node} is back after {loss.back_after_s:.1f} s")

    def _note(
        self, node: str, what: str, said: str = "", given_up: str = "", then: str = ""
    ) -> Loss:
        loss = Loss(node, what, round(time.monotonic() - self._began, 2), said, given_up=given_up)
        self.losses.append(loss)
        last = f", and last said: {said}" if said else ""
        say(f"{node} {what} after {loss.at_s:.1f} s{last}; {given_up or then}".removesuffix("; "))
        return loss

    def _publish(self) -> None:
        self._monitor.node.tell_lost([str(loss) for loss in self.losses])

    def _note_full_disk(self) -> None:
        """Note once that the recorder could not write."""
        node = self._monitor.node
        if node.rejected(RECORDER, "disk") > 0 and not self._is_disk_full:
            self._is_disk_full = True
            self._note(RECORDER, f"could not write ({node.messages.get(RECORDER, '')})")
            self._publish()


def say(sentence: str) -> None:
    """Print a sentence to the person, above the bar."""
    tqdm.write(f"us-sim: {printable(sentence)}", file=sys.stderr)


def going_on(process: NodeProcess, report: Mapping[str, str]) -> NodeProcess:
    """Return the process that goes on in place of one that has ended.

    A recorder goes on in a further file, and a viewer at the port where pages look for it. What
    plays a path goes on where that would be by now, as a tracker's motion would: what it did not
    send meanwhile is missing.

    Args:
        process: as it was started at first.
        report: the last that it gave.
    """
    if process.node == RECORDER:
        more: dict[str, object] = {"if_exists": "further"}
    elif process.node == VIEWER:
        port = report.get("port", "")
        more = {"port": int(port)} if port.isdecimal() and len(port) < 6 else {}
    else:
        try:
            more = {"begun": float(report["begun"])}
        except (KeyError, ValueError):  # it does not play, or what it said is no number
            return process
    return replace(process, parameters=process.parameters | more)
