"""A plan of node processes, kept running while another may take its place, and ended together."""

from __future__ import annotations

import sys
import time
from collections.abc import Collection, Mapping
from dataclasses import replace

from tqdm import tqdm

from us_sim.errors import printable
from us_sim.nodes import INTERRUPTED
from us_sim.nodes.settings import PLAYERS, RECORDER, VIEWER
from us_sim.run.losses import IMAGES, Loss, Outcome, Recordings, images_in
from us_sim.run.monitored import Monitored
from us_sim.run.plan import NodeProcess, Plan, goes_on, recorder_of
from us_sim.run.processes import ProcessGroup, ending
from us_sim.run.ros_arguments import namespace
from us_sim.run.watch import BUSY_FACTOR, START_LIMIT_S, Restarts, SupervisionSettings, Watch

LIVES_S = 10.0
"""How long a node that was started again lives if what was set of it is not why it ended."""
Kept = dict[str, dict[str, object]]
"""Parameters that were set while nodes ran: values by names, by node."""
IMAGER = "slice_interpolator"


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
        self.losses: list[Loss] = []
        self.finished = False  # whether what is played is at its end, or given up
        self._group, self._monitor, self._settings = group, monitor, settings
        self._watch = Watch(settings.silence)
        self._away: dict[str, tuple[Loss, float]] = {}  # started again, and when they were lost
        self._back: dict[str, float] = {}  # when they were back
        self._were_ready: set[str] = set()
        self._processes: dict[str, NodeProcess] = {}  # that were started, by node
        self._due: list[NodeProcess] = []  # that are started when others have ended
        self.recordings = Recordings()
        self._images = monitor.node.resolve_topic_name(IMAGES)  # also once the node has ended
        self._is_disk_full = False
        self._began = time.monotonic()
        self._changes = 0
        self.change(plan)

    def change(self, plan: Plan, anew: Collection[str] = ()) -> None:
        """Run this plan; processes that the plan before had, too, go on.

        Others are told to end, and new ones are started by `update` once they have.

        Args:
            plan: what runs from now on.
            anew: nodes that do not go on even so.
        """
        wanted = {process.node: process for process in plan.processes}
        for node, process in list(self._processes.items()):
            if node in anew or not goes_on(process, wanted.get(node)):
                self._group.dismiss(node)
                del self._processes[node]
                self._away.pop(node, None)
                self._were_ready.discard(node)
        self._plan, self.finished = plan, False
        self._due = [each for each in plan.processes if each.node not in self._processes]
        self._restarts = Restarts(self._settings)
        self._changed = time.monotonic()
        self._changes += 1
        self._monitor.node.follow(plan.nodes)
        self._start_due()

    @property
    def plan(self) -> Plan:
        """The plan that runs, or is about to."""
        return self._plan

    @property
    def started(self) -> set[str]:
        """Nodes of it that were started."""
        return set(self._processes)

    @property
    def waiting(self) -> list[str]:
        """Nodes that have not reported yet, or not yet again."""
        due = [process.node for process in self._due]
        return due + self._monitor.waiting(self._group.pids)

    def failed(self) -> str:
        """Why the plan cannot run, where a node of it is given up before all were ready."""
        late = self.waiting
        limit = BUSY_FACTOR * START_LIMIT_S
        if late and time.monotonic() - self._changed > limit:
            return f"{', '.join(late)} did not start in {limit / 60:g} minutes"
        given_up = (loss for loss in self.losses if loss.given_up and loss.node in late)
        return str(next(given_up, ""))

    def gave_up(self, node: str) -> bool:
        """Whether a node has ended and is not started again."""
        return any(loss.given_up for loss in self.losses if loss.node == node)

    def keep(self, node: str, values: Mapping[str, object]) -> None:
        """Parameters that a node was given while it runs: started again, it has them, too."""
        if node in self._processes:
            process = self._processes[node]
            self._processes[node] = replace(process, kept=process.kept | dict(values))

    @property
    def kept(self) -> Kept:
        """Parameters that were set of each node; nothing of one that has ended twice of them.

        Nodes that are told by others how to go on are left out.
        """
        own = self._processes.keys() - {*PLAYERS, RECORDER, VIEWER}
        return {node: self._processes[node].kept for node in own}

    def update(self) -> None:
        """Take new reports, and restart nodes that have ended or hang.

        Raises:
            UsSimError: a node that was never ready cannot work, in its own words.
        """
        self._monitor.spin()
        self._start_due()
        ended = self._group.take_ended()
        for _ in range(2 * len(self._processes) if ended else 0):
            self._monitor.spin(0.0)  # what they said last, and what was set of them
        own = self.kept.keys()
        for node, values in self._monitor.node.take_set().items():
            if node in own:
                self.keep(node, values)
        for node, status in ended.items():
            self._ended(node, status)
        parts = {
            node: [part.node for part in process.parts] for node, process in self._processes.items()
        }
        hung = self._watch.hung(self._running(), self._monitor.node.heard, parts)
        for node, how in hung.items():
            said = self._monitor.node.messages.get(node) or self._group.last_words(node)
            self._group.end(node)
            self._lose(node, how, said)
        self._welcome()
        self._note_full_disk()

    def _start_due(self) -> None:
        """Start nodes that are due, unless a dismissed one may still publish beside them.

        The recorder may take long to write, and disturbs nobody but another recorder.
        """
        leaving = self._group.leaving()
        if leaving.get(RECORDER):
            self._note_killed_recorder()
        others = leaving.keys() - {RECORDER}
        ready = [
            process
            for process in self._due
            if not (others if process.node != RECORDER else RECORDER in leaving)
        ]
        for process in ready:
            self._due.remove(process)
            self._processes[process.node] = process
            if process.node == RECORDER:
                self.recordings.begin(process)
        if ready:
            self._group.start(ready)

    def end(self) -> None:
        """End all nodes; a recorder that had to be killed is lost, as is who is not back."""
        for loss, _ in self._away.values():
            loss.given_up = "was not back when the run ended"
        if RECORDER in self._group.stop():
            self._note_killed_recorder()

    def _note_killed_recorder(self) -> None:
        loss = self._loss(RECORDER, "did not end when it was told to and was killed", "")
        loss.given_up = "its last messages may be missing"
        self._note(loss, loss.given_up)

    def outcome(self, startup: float) -> Outcome:
        """How it went, once all has ended."""
        files = self.recordings.files()
        recorded = images_in(files, self._images)
        # How many images were to be recorded is only known where all that were made were.
        recorder = recorder_of(self._plan.processes)
        all_were = recorder and recorder.at_once and recorder.records(self._images, namespace())
        is_known = all_were and self._changes == 1
        made = self._monitor.node.count(IMAGER, IMAGES) if is_known else recorded
        poses = None if self._plan.loops else self._plan.poses
        awaited = self._monitor.node.reports.get(self._plan.player, {}).get("awaited", "")
        return Outcome(startup, self.losses, files, made, recorded, poses, awaited)

    def _running(self) -> Mapping[str, int]:
        group = self._group
        return {node: pid for node, pid in group.pids.items() if group.is_running(node)}

    def _ended(self, node: str, status: int) -> None:
        plays = self._plan.poses is not None and node == self._plan.player
        if plays and status == 0:  # it has another where it was told to end before
            self.finished = True
            return
        if status > 0 and status != INTERRUPTED and node not in self._were_ready:
            raise self._group.failure(node, status)
        self._lose(node, ending(status), self._group.last_words(node))

    def _lose(self, node: str, what: str, said: str) -> None:
        loss = self._loss(node, what, said)
        loss.given_up = self._restarts.refused(node)
        self._note(loss, loss.given_up or "it is started again" + self._without_kept(node))
        self._publish()
        if loss.given_up:
            self._away.pop(node, None)
            self.finished |= node == self._plan.player
            return
        report = self._monitor.node.reports.get(node, {})
        own = report.get("pid") == str(self._group.pids[node])
        process = going_on(self._processes[node], report if own else {})
        self._group.start([process])
        self._away[node] = loss, time.monotonic()

    def _without_kept(self, node: str) -> str:
        """Drop settings with which a node dies soon; return the sentence on it."""
        process = self._processes[node]
        lived = time.monotonic() - self._back.get(node, -LIVES_S)
        if not process.kept or (node not in self._away and lived > LIVES_S):
            return ""
        self._processes[node] = replace(process, kept={})
        return f", without what was set since its start: {', '.join(process.kept)}"

    def _welcome(self) -> None:
        waiting = self.waiting
        self._were_ready |= self._group.pids.keys() - set(waiting)
        for node in [node for node in self._away if node not in waiting]:
            loss, since = self._away.pop(node)
            self._back[node] = time.monotonic()
            loss.back_after = self._back[node] - since
            self._publish()
            say(f"{node} is back after {loss.back_after:.1f} s")

    def _loss(self, node: str, what: str, said: str) -> Loss:
        return Loss(node, what, time.monotonic() - self._began, said)

    def _note(self, loss: Loss, then: str = "") -> None:
        self.losses.append(loss)
        last = f", and last said: {loss.said}" if loss.said else ""
        say(f"{loss.node} {loss.what} after {loss.at:.1f} s{last}; {then}".removesuffix("; "))

    def _publish(self) -> None:
        self._monitor.node.tell_lost([str(loss) for loss in self.losses])

    def _note_full_disk(self) -> None:
        """Note it when the recorder cannot write any more; it may again when there is room."""
        node = self._monitor.node
        is_full = node.rejected(RECORDER, "disk") > 0
        if is_full and not self._is_disk_full:
            what = f"could not write any more ({node.messages[RECORDER]})"
            self._note(self._loss(RECORDER, what, ""))
            self._publish()
        self._is_disk_full = is_full


def say(sentence: str) -> None:
    """To the person, above the bar."""
    tqdm.write(f"us-sim: {printable(sentence)}", file=sys.stderr)


def going_on(process: NodeProcess, report: Mapping[str, str]) -> NodeProcess:
    """The process that goes on in place of one that has ended.

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
    return replace(process, given=process.given | more)
