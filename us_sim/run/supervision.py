"""A plan of node processes, kept running, followed by what they report, and ended together."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Mapping
from pathlib import Path

from tqdm import tqdm

from us_sim.errors import UsSimError
from us_sim.progress import Progress
from us_sim.run.domain_lock import alone_on_domain
from us_sim.run.graph import INTERRUPTED, RECORDER, ProcessGroup, ending
from us_sim.run.losses import Loss, Outcome, files_of, images_in
from us_sim.run.monitored import Monitored
from us_sim.run.plan import Plan
from us_sim.run.restarts import Restarts, going_on
from us_sim.run.supervision_settings import SupervisionSettings
from us_sim.run.watch import START_LIMIT_S, Watch

__all__ = ["Supervisor", "follow"]

SETTLE_S = 1.2
"""After the path's end: the last images, and each node's last report, which comes every second."""
RIVALRY_S = 5.0
"""After all nodes are ready: to see a simulation elsewhere that began at the same moment."""
SLOW = ("tissue_deformer", "slice_interpolator", "skin_deformer")
"""Nodes that take long to start, and hold no device that a second process could not have."""
IMAGER, IMAGES = "slice_interpolator", "ultrasound/image"


class Supervisor:
    """Keeps the nodes of a plan running: one that ends or hangs is started again.

    What is noticed is said, kept in `losses`, and published on ``diagnostics``, so that it is in
    the recording.

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
        self._plan, self._group, self._monitor = plan, group, monitor
        self._watch = Watch(settings.silence)
        self._restarts = Restarts(settings)
        self._away: dict[str, tuple[Loss, float]] = {}  # started again, and when they were lost
        self._were_ready: set[str] = set()
        self._processes = {process.node: process for process in plan.processes}
        self._is_disk_full = False
        self._standby = settings.standby
        self._older = self._recorded()
        self._began = time.monotonic()
        group.start(plan.processes)

    @property
    def waiting(self) -> list[str]:
        """Nodes that have not reported yet, or not yet again."""
        return self._monitor.waiting(self._group.pids)

    def look(self) -> None:
        """Take what has come, and see to nodes that have ended or hang.

        Raises:
            UsSimError: a node that was never ready cannot work, in its own words.
        """
        self._monitor.spin()
        for node, status in self._group.take_ended().items():
            self._ended(node, status)
        hung = self._watch.look(self._running(), self._monitor.node.heard)
        for node, how in hung.items():
            said = self._monitor.node.messages.get(node) or self._group.last_words(node)
            self._group.end(node)
            self._lose(node, how, said)
        self._welcome()
        self._look_at_the_disk()
        if self._standby:
            self._prepare()

    def end(self) -> None:
        """End all nodes; a recorder that had to be killed is lost."""
        if RECORDER in self._group.stop():
            loss = self._loss(RECORDER, "did not end when it was told to and was killed", "")
            loss.given_up = "its last messages may be missing"
            self._note(loss, loss.given_up)

    def outcome(self, startup: float) -> Outcome:
        """How it went, once all has ended."""
        made = self._monitor.node.count(IMAGER, IMAGES)
        files = [file for file in self._recorded() if file not in self._older]
        poses = None if self._plan.loops else self._plan.poses
        return Outcome(startup, self.losses, files, made, images_in(files), poses)

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
        """Note it, and start the node again if that may be."""
        loss = self._loss(node, what, said)
        loss.given_up = self._restarts.refused(node)
        self._note(loss, loss.given_up or "it is started again")
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

    def _welcome(self) -> None:
        """Note which nodes have reported for the first time, or again."""
        waiting = self.waiting
        self._were_ready |= self._group.pids.keys() - set(waiting)
        for node in [node for node in self._away if node not in waiting]:
            loss, since = self._away.pop(node)
            loss.back_after = time.monotonic() - since
            self._publish()
            _say(f"{node} is back after {loss.back_after:.1f} s")

    def _prepare(self) -> None:
        """Have the next node stand by, one at a time, while all others run."""
        if self.waiting:
            return
        for node in SLOW:
            running = node in self._processes and self._group.is_running(node)
            if running and not self._group.stand_by(self._processes[node]):
                return

    def _loss(self, node: str, what: str, said: str) -> Loss:
        return Loss(node, what, time.monotonic() - self._began, said)

    def _note(self, loss: Loss, then: str = "") -> None:
        self.losses.append(loss)
        last = f", and last said: {loss.said}" if loss.said else ""
        _say(f"{loss.node} {loss.what} after {loss.at:.1f} s{last}; {then}".removesuffix("; "))

    def _publish(self) -> None:
        """Tell diagnostics, which a recorder records."""
        self._monitor.node.tell_lost([str(loss) for loss in self.losses])

    def _look_at_the_disk(self) -> None:
        """Note it when the recorder cannot write any more; it may again when there is room."""
        node = self._monitor.node
        is_full = "rejected disk" in node.reports.get(RECORDER, {})
        if is_full and not self._is_disk_full:
            what = f"could not write any more ({node.messages[RECORDER]})"
            self._note(self._loss(RECORDER, what, ""))
            self._publish()
        self._is_disk_full = is_full

    def _recorded(self) -> list[Path]:
        """The files of the recording, with any that were there before."""
        if RECORDER not in self._processes:
            return []
        return files_of(Path(str(self._processes[RECORDER].all_parameters["file"])))


def follow(plan: Plan, log: Path | None, settings: SupervisionSettings) -> Outcome:
    """Start the plan's processes and stay with them until they are done; how it went.

    Args:
        plan: what runs.
        log: where what they say goes; None is the terminal.
        settings: when a node hangs, and how often it is started again.

    Raises:
        UsSimError: a node cannot start, or another simulation runs on this domain.
    """
    with alone_on_domain():
        group = ProcessGroup(log)
        supervisor = None
        startup = 0.0
        try:
            # The monitor goes first: it would wait for what a killed node never acknowledges.
            with contextlib.closing(Monitored(plan.nodes, supervised=True)) as monitor:
                monitor.refuse_company()
                began = time.monotonic()
                supervisor = Supervisor(plan, group, monitor, settings)
                _await_all(supervisor, monitor, began)
                monitor.refuse_unknown(plan.processes)
                startup = time.monotonic() - began
                _stay(plan, supervisor, monitor)
        except KeyboardInterrupt:
            if supervisor is not None:
                supervisor.end()
                lost = supervisor.outcome(startup).sentence()
                if lost:
                    _say(lost)
            raise
        finally:
            (group.stop if supervisor is None else supervisor.end)()
        return supervisor.outcome(startup)


def _await_all(supervisor: Supervisor, monitor: Monitored, began: float) -> None:
    """Until every node has reported."""
    with Progress("starting (the first run compiles)", len(monitor.names), "nodes") as bar:
        while waiting := supervisor.waiting:
            supervisor.look()
            monitor.refuse_earlier_run()
            more = f" and {len(waiting) - 2} more" if len(waiting) > 2 else ""
            bar.update(len(monitor.names) - len(waiting), ", ".join(waiting[:2]) + more)
            given_up = next((loss for loss in supervisor.losses if loss.given_up), None)
            if given_up is not None:
                raise UsSimError(str(given_up))
            if time.monotonic() - began > START_LIMIT_S:
                raise UsSimError(f"{', '.join(waiting)} did not start in {START_LIMIT_S:g} s")


def _stay(plan: Plan, supervisor: Supervisor, monitor: Monitored) -> None:
    """Until the path is at its end, or the time is up."""
    began = time.monotonic()
    ended: float | None = None
    plays = plan.poses is not None
    total = plan.duration if not plays else None if plan.loops else plan.poses
    unit = "s" if not plays else "poses" if plan.player == "path_player" else "images"
    with Progress("running", total, unit) as bar:
        while True:
            supervisor.look()
            now = time.monotonic()
            if now - began < RIVALRY_S:
                monitor.refuse_earlier_run()
            done = _played(plan, monitor) if plays else now - began
            bar.update(min(done, total or done), _status(plan, monitor))
            if supervisor.finished and ended is None:
                ended = now
            if plan.duration is not None and now - began > plan.duration:
                return
            if ended is not None and now - ended > SETTLE_S:
                return


def _played(plan: Plan, monitor: Monitored) -> float:
    """How far what is played has come, in poses or images."""
    text = monitor.node.reports.get(plan.player, {}).get("played", "")
    return float(text) if text.isdecimal() and len(text) < 12 else 0.0


def _status(plan: Plan, monitor: Monitored) -> str:
    """The images so far, their rate and their age, in words."""
    again = f"begins again every {plan.poses}; " if plan.loops else ""
    slicer = monitor.node.reports.get(IMAGER, {})
    count = monitor.node.count(IMAGER, IMAGES)
    if not count:
        heard = slicer.get("received", "0") != "0"
        return again + ("nobody subscribes to ultrasound/image" if heard else "waiting for poses")
    return (
        f"{again}{count} images, {slicer.get('rate_hz', '?')}/s, "
        f"p99 {slicer.get('latency_p99_ms', '?')} ms"
    )


def _say(sentence: str) -> None:
    """To the person, above the bar."""
    tqdm.write(f"us-sim: {sentence}", file=sys.stderr)
