"""A plan of node processes, kept running while another may take its place, and ended together."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import replace

from tqdm import tqdm

from us_sim.errors import printable
from us_sim.nodes import INTERRUPTED
from us_sim.nodes.settings import RECORDER, VIEWER
from us_sim.run.losses import IMAGER, IMAGES, Loss, Outcome, Recordings, images_in
from us_sim.run.monitored import Monitored
from us_sim.run.plan import NodeProcess, Plan, goes_on, recorder_of
from us_sim.run.processes import ProcessGroup, ending
from us_sim.run.ros_arguments import namespace
from us_sim.run.watch import START_S, SupervisionSettings, Watch
from us_sim.settings.spelling import counted


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
        self._watch = Watch(settings.silence)
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
            self._were_ready.discard(node)
        self.plan, self.finished = plan, False
        self._restarts: Counter[str] = Counter()
        self._changed = time.monotonic()
        self._changes += 1
        self._monitor.node.follow(plan.nodes)
        new = [
            each for each in plan.processes if each.node in over or each.node not in self._processes
        ]
        self._processes = wanted
        if RECORDER in wanted:
            self.recordings.begin(wanted[RECORDER])
        self._group.start(new)

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
        if late and time.monotonic() - self._changed > START_S:
            return f"{', '.join(late)} did not start in {START_S / 60:g} minutes"
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
        running = {n: pid for n, pid in self._group.pids.items() if self._group.is_running(n)}
        for node, how in self._watch.hung(running, self._monitor.node.heard).items():
            said = self._monitor.node.messages.get(node) or self._group.last_words(node)
            self._group.end([node])
            self._on_lost(node, how, said)
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
    plays a path or a video goes on where that would be by now, as a tracker's motion would: what it
    did not send meanwhile is missing.

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
