"""Node processes watched and started again, and what was lost meanwhile.

A node hangs that says nothing on ``diagnostics`` for too long.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from tqdm import tqdm

from us_sim.errors import BagError, UsSimError, printable_line
from us_sim.nodes import INTERRUPTED
from us_sim.nodes.settings import RECORDER, VIEWER
from us_sim.run.domain import get_domain, get_namespace, make_ros_context
from us_sim.run.plan import NodeProcess, Plan, can_continue, find_recorder
from us_sim.run.processes import COMPLAINT, RunningNode, describe_ending, end_nodes
from us_sim.run.shared_memory import remove_abandoned_segments
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting
from us_sim.settings.spelling import format_count

if TYPE_CHECKING:
    from rclpy.node import Node

    from us_sim.nodes.session_control import SessionControl, Use
    from us_sim.nodes.session_monitor import SessionMonitor
    from us_sim.nodes.settings import SessionControlSettings

IMAGES, IMAGER = "ultrasound/image", "slice_interpolator"
RECORDER_STOP_S = 10.0  # a recorder may take to end: it writes what it still holds
START_S = 900.0  # for the first report: a first run compiles for minutes
RESTART_S = 120.0  # likewise of a node that was ready before, whose kernels are kept
STEP_S = 0.5  # the most that counts between two looks: it was stopped meanwhile, or had no time
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
class NodeLoss:
    """A node that ended or hung, and its restart."""

    node: str
    what: str  # it did: "was ended by SIGKILL"
    at_s: float  # since the nodes were started
    back_after_s: float | None = None  # until it reported again
    given_up: str = ""  # why it was not started again

    def __str__(self) -> str:
        """Say it to a person."""
        then = f" and {self.given_up}" if self.given_up else ""
        if self.back_after_s is not None:
            then = f" and was back after {self.back_after_s:.1f} s"
        return f"{self.node} {self.what} at {self.at_s:.1f} s{then}"


@dataclass(frozen=True)
class Outcome:
    """The result of a run."""

    startup: float  # s until all nodes were ready
    files: Sequence[Path]  # recorded, in their order
    losses: Sequence[str]  # sentences, for a person

    def describe_losses(self) -> str:
        """Return the losses in one; nothing when there are none."""
        if not self.losses:
            return ""
        told = list(self.losses[:TOLD])
        if len(self.losses) > TOLD:
            told.append(f"and {len(self.losses) - TOLD} more times nodes ended or hung")
        if self.files:
            told.append(f"the recording is in {', '.join(file.name for file in self.files)}")
        return "; ".join(told)


def count_images(files: Sequence[Path], name: str) -> int:
    """Count the images on a topic in recordings; a file that cannot be read has none."""
    from us_sim.recording.reader import read_bag  # takes long to import, and starts need it not

    count = 0
    for file in files:
        with contextlib.suppress(BagError):
            topics = read_bag(file).topics
            count += sum(topic.message_count for topic in topics if topic.name == name)
    return count


class Supervisor:
    """The keeper of a plan's running nodes: one that ends or hangs is started again.

    Another plan may take its place while it runs. What is noticed is said, kept in `losses`, and
    published on ``diagnostics``, so that it is in the recording.

    Args:
        settings: when a node hangs, and how often it is started again.
        log: where what nodes say goes; None shows it on this terminal, above any progress.
    """

    monitor: SessionMonitor  # hears what they report

    def __init__(self, settings: SupervisionSettings, log: Path | None = None) -> None:
        self.plan = Plan([])
        self.losses: list[NodeLoss] = []
        self.finished = False  # whether what is played is at its end, or given up
        self._settings, self._log_path = settings, log
        self._log: IO[str] | None = log.open("w", 1, encoding="utf-8") if log else None  # by lines
        self._listening = contextlib.ExitStack()  # leaves the domain
        self._running: dict[str, RunningNode] = {}  # the last process of each node
        self._started: set[tuple[str, int]] = set()  # nodes and processes
        self._strangers: set[tuple[str, int]] = set()  # likewise, that others have started
        self._looked, self._watched = time.monotonic(), 0.0  # s
        self._away: dict[str, NodeLoss] = {}  # that are being started again
        self._were_ready: set[str] = set()
        self._restarts: Counter[str] = Counter()
        self._began = time.monotonic()
        self._startup: float | None = None  # s
        self._changes = 0

    def start_plan(self, plan: Plan) -> None:
        """Start the nodes of a plan, and hear them; a page loads while ROS is imported here."""
        self._start(each for each in plan.processes if each.node == VIEWER)
        self._listen(plan.nodes)
        self._images = self.monitor.resolve_topic_name(IMAGES)
        self.change_plan(plan)

    def _listen(self, nodes: Sequence[str]) -> None:
        """Make the monitor, in a context and an executor of its own."""
        from rclpy.executors import SingleThreadedExecutor

        from us_sim.nodes.session_monitor import SessionMonitor

        context = make_ros_context()
        self._listening.callback(context.try_shutdown)
        self._executor: Any = SingleThreadedExecutor(context=context)
        self._listening.callback(self._executor.shutdown)
        self.monitor = SessionMonitor(nodes, context=context)
        self._add(self.monitor)

    def _add(self, node: Node) -> None:
        self._executor.add_node(node)
        self._listening.callback(node.destroy_node)
        self._listening.callback(self._executor.remove_node, node)

    def add_control(
        self, check: Use, take: Use, settings: SessionControlSettings
    ) -> SessionControl:
        """Make the node by which a simulation with these settings is controlled."""
        from us_sim.nodes.session_control import SessionControl

        control = SessionControl(check, take, settings, context=self.monitor.context)
        self._add(control)
        return control

    def change_plan(self, plan: Plan, anew: Collection[str] = ()) -> None:
        """Run this plan; processes that it shares with the one before go on, but for ``anew``."""
        wanted = {process.node: process for process in plan.processes}
        over = [
            process.node
            for process in self.plan.processes
            if process.node in anew or not can_continue(process, wanted.get(process.node))
        ]
        self._end(over)  # before others of the same names are started
        for node in over:
            del self._running[node]
            self._away.pop(node, None)
        self._were_ready -= {*over}
        self.plan, self.finished = plan, False
        self._restarts.clear()
        self._changes += 1
        self.monitor.follow_nodes(plan.nodes)
        self._start(each for each in plan.processes if each.node not in self._running)

    def _start(self, processes: Iterable[NodeProcess]) -> None:
        remove_abandoned_segments()  # of one that is replaced
        for process in processes:
            is_forked = process.node != VIEWER  # which shares little, and shall be there first
            running = RunningNode(process, self._show, is_forked=is_forked)
            self._running[process.node] = running
            self._started.add((process.node, running.pid))

    def _end(self, nodes: Collection[str]) -> None:
        """End these nodes, the recorder after the others."""
        running = [self._running[node] for node in nodes if node in self._running]
        end_nodes([each for each in running if each.node.node != RECORDER])
        if end_nodes([each for each in running if each.node.node == RECORDER], RECORDER_STOP_S):
            what = "did not end when it was told to and was killed"
            self._note(RECORDER, what, given_up="its last messages may be missing")

    def _show(self, node: str, line: str) -> None:
        if self._log is not None:
            with contextlib.suppress(OSError, ValueError):  # a full disk; or it is closed
                self._log.write(line)
        is_for_person = self._log is None or node == VIEWER  # which says where its page is
        if is_for_person and not line.startswith(COMPLAINT):  # which is said when it has ended
            tqdm.write(printable_line(line.rstrip()), file=sys.stderr)

    @property
    def waiting(self) -> list[str]:
        """List the nodes that have not reported yet, or not yet again."""
        heard = self.monitor.heard
        return [node for node, each in self._running.items() if (node, each.pid) not in heard]

    def update(self) -> None:
        """Take new reports, and restart nodes that have ended or hang.

        Raises:
            UsSimError: the plan cannot run: before all were ready a node is given up, or says why
                it cannot work.
        """
        self._executor.spin_once(timeout_sec=0.1)
        ended = [each for each in self._running.values() if not each.is_noted]
        ended = [each for each in ended if each.status is not None]
        for _ in range(2 * len(self._running) if ended else 0):
            self._executor.spin_once(timeout_sec=0.0)  # what they said last
        for each in ended:
            each.note_end()
            self._on_ended(each)
        self._end_silent()
        self._note_ready()
        self._note_strangers()

    def end_plan(self) -> None:
        """End all nodes; a recorder that had to be killed is lost, as is who is not back.

        The monitor goes first: it would wait for what a killed node never acknowledges.
        """
        for loss in self._away.values():
            loss.given_up = "was not back when the run ended"
        self._away.clear()
        self._listening.close()
        self._end([*self._running])
        remove_abandoned_segments()
        if self._log is not None:
            with contextlib.suppress(OSError):
                self._log.close()

    def make_outcome(self) -> Outcome:
        """Return how it went, once all has ended."""
        node, losses = self.monitor, [str(loss) for loss in self.losses]
        recorded_by = node.recordings.items()
        files = [Path(file) for file, pid in recorded_by if (RECORDER, pid) in self._started]
        # How many images were to be recorded is only known where all that were made were.
        recorder = find_recorder(self.plan.processes) if files and self._changes == 1 else None
        if (
            recorder
            and not recorder.paused
            and recorder.records_topic(self._images, get_namespace())
        ):
            made, recorded = node.count_messages(IMAGER, IMAGES), count_images(files, self._images)
            if recorded < made:
                losses.insert(0, f"{recorded} images were recorded of {made} that were made")
        if files and (lost := node.count_messages(RECORDER, "dropped")):
            losses.insert(0, f"{format_count(lost, 'message')} not recorded")
        if awaited := node.reports.get(self.plan.player, {}).get("awaited", ""):
            losses.insert(0, f"nothing was played: it waited for {awaited}")
        return Outcome(self._startup or 0.0, files, losses)

    def _on_ended(self, running: RunningNode) -> None:
        node, status = running.node.node, running.status or 0
        plays = self.plan.poses is not None and node == self.plan.player
        if plays and status == 0:  # it has another where it was told to end before
            self.finished = True
        elif status > 0 and status != INTERRUPTED and node not in self._were_ready:
            see = f"; see {self._log_path}" if self._log_path else ""
            raise UsSimError(running.complaint or f"{node} {describe_ending(status)}{see}")
        else:
            self._on_lost(node, describe_ending(status), running.last_words)

    def _end_silent(self) -> None:
        """End nodes that have not reported for too long, and start them again."""
        now = time.monotonic()
        self._watched += min(now - self._looked, STEP_S)
        self._looked = now
        for node, running in [*self._running.items()]:
            if running.is_noted:
                continue
            count = self.monitor.heard[node, running.pid]
            silent = self._watched - running.heard_at
            if count != running.reports:
                running.reports, running.heard_at = count, self._watched
            elif silent > (self._settings.silence if count else self._patience(node)):
                if node not in self._were_ready:
                    raise UsSimError(f"{node} did not start in {START_S / 60:g} minutes")
                said = self.monitor.messages.get(node) or running.last_words
                self._end([node])
                self._on_lost(node, f"has not reported for {silent:.0f} s", said)

    def _patience(self, node: str) -> float:
        """Return how long (s) a node may take to its first report."""
        return max(RESTART_S, self._settings.silence) if node in self._were_ready else START_S

    def _on_lost(self, node: str, what: str, said: str) -> None:
        """Note a node's end, and start it again with the values that it was first started with."""
        limit, given_up = self._settings.restarts, ""
        if self._restarts[node] >= limit:
            given_up = f"is not started again after {format_count(limit, 'restart')}"
        loss = self._note(node, what, said, given_up)
        self.monitor.report_losses([str(each) for each in self.losses])
        self._restarts[node] += 1
        if given_up:
            self._away.pop(node, None)
            self.finished |= node == self.plan.player
            if not self._were_ready.issuperset(self.plan.nodes):
                raise UsSimError(str(loss))
            return
        report = self.monitor.reports.get(node, {})
        is_own = report.get("pid") == str(self._running[node].pid)
        first = next(each for each in self.plan.processes if each.node == node)
        self._start([continue_process(first, report if is_own else {})])
        self._away[node] = loss

    def _note_ready(self) -> None:
        waiting = self.waiting
        if not waiting and self._startup is None:
            self._startup = time.monotonic() - self._began
        self._were_ready |= self._running.keys() - set(waiting)
        for node in [node for node in self._away if node not in waiting]:
            loss = self._away.pop(node)
            loss.back_after_s = round(time.monotonic() - self._began - loss.at_s, 2)
            self.monitor.report_losses([str(each) for each in self.losses])
            print_above_bar(f"{node} is back after {loss.back_after_s:.1f} s")

    def _note_strangers(self) -> None:
        """Say once of each node of another simulation that it is here, too."""
        for each in self.monitor.heard.keys() - self._started - self._strangers:
            self._strangers.add(each)
            print_above_bar(
                f"another {each[0]} is on ROS domain {get_domain()}: end that simulation, or set "
                f"ROS_DOMAIN_ID to another number for this one"
            )

    def _note(self, node: str, what: str, said: str = "", given_up: str = "") -> NodeLoss:
        loss = NodeLoss(node, what, round(time.monotonic() - self._began, 2), given_up=given_up)
        self.losses.append(loss)
        last = f", and last said: {said}" if said else ""
        print_above_bar(
            f"{node} {what} after {loss.at_s:.1f} s{last}; {given_up or 'it is started again'}"
        )
        return loss


def print_above_bar(sentence: str) -> None:
    """Print a sentence to the person, above the bar."""
    tqdm.write(f"us-sim: {printable_line(sentence)}", file=sys.stderr)


def continue_process(process: NodeProcess, report: Mapping[str, str]) -> NodeProcess:
    """Return the process that goes on in place of one that has ended.

    A recorder goes on in a further file, and a viewer at the port where pages look for it, as its
    last report says. What plays a path goes on where that would be by now, as a tracker's motion
    would: what it did not send meanwhile is missing.
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
