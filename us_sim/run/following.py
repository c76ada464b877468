"""Staying with a run until it is done, in view of the person who started it."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from pathlib import Path

from us_sim.errors import UsSimError
from us_sim.progress import Progress
from us_sim.run.domain_lock import alone_on_domain
from us_sim.run.forking import ForkServer
from us_sim.run.graph import VIEWER, ProcessGroup
from us_sim.run.losses import Outcome
from us_sim.run.monitored import Monitored
from us_sim.run.plan import Plan
from us_sim.run.request import Request
from us_sim.run.simulation import Simulation
from us_sim.run.supervision import IMAGER, IMAGES, Supervisor, say
from us_sim.run.supervision_settings import SupervisionSettings

SETTLE_S = 1.2
"""After the path's end: the last images, and each node's last report, which comes every second."""
RIVALRY_S = 5.0
"""After all nodes are ready: to see a simulation elsewhere that began at the same moment."""


def follow(
    plan: Plan,
    log: Path | None,
    settings: SupervisionSettings,
    request: Request | None = None,
    forks: ForkServer | None = None,
) -> Outcome:
    """Start the plan's processes and stay with them until they are done; how it went.

    Args:
        plan: what runs.
        log: where what they say goes; None is the terminal.
        settings: when a node hangs, and how often it is started again.
        request: that the plan was made for, which may change while it runs. None where what runs
            is no simulation, of which there is one on a domain.
        forks: that the processes are forked from; None starts each as a program.

    Raises:
        UsSimError: a node cannot start, or another simulation runs on this domain.
    """
    with contextlib.nullcontext() if request is None else alone_on_domain():
        group = ProcessGroup(log, forks)
        supervisor = simulation = None
        startup = 0.0
        # A page loads while the others are looked for and started.
        early = [each for each in plan.processes if each.node == VIEWER and request is not None]
        try:
            group.start(early)
            # The monitor goes first: it would wait for what a killed node never acknowledges.
            supervised = request is not None
            with contextlib.closing(Monitored(plan.nodes, supervised=supervised)) as monitor:
                monitor.refuse_company(set(plan.nodes) - {each.node for each in early})
                began = time.monotonic()
                supervisor = Supervisor(plan, group, monitor, settings)
                look = supervisor.look
                if request is not None:
                    simulation = Simulation(request, supervisor, monitor)
                    look = simulation.look
                _await_all(look, supervisor, monitor)
                monitor.refuse_unknown(plan.processes)
                startup = time.monotonic() - began
                _stay(look, supervisor, monitor)
        except KeyboardInterrupt:
            if supervisor is not None:
                supervisor.end()
                lost = supervisor.outcome(startup).sentence()
                if lost:
                    say(lost)
            raise
        finally:
            if simulation is not None:
                simulation.close()
            (group.stop if supervisor is None else supervisor.end)()
        return supervisor.outcome(startup)


def _await_all(look: Callable[[], None], supervisor: Supervisor, monitor: Monitored) -> None:
    """Until every node has reported."""
    count = len(supervisor.plan.nodes)
    with Progress("starting (the first run compiles)", count, "nodes") as bar:
        while waiting := supervisor.waiting:
            look()
            monitor.refuse_earlier_run()
            more = f" and {len(waiting) - 2} more" if len(waiting) > 2 else ""
            bar.update(count - len(waiting), ", ".join(waiting[:2]) + more)
            failed = supervisor.failed()
            if failed:
                raise UsSimError(failed)


def _stay(look: Callable[[], None], supervisor: Supervisor, monitor: Monitored) -> None:
    """Until the path is at its end, or the time is up."""
    began = time.monotonic()
    ended: float | None = None
    while True:
        plan = supervisor.plan
        total, unit = _shown(plan)
        with Progress("running", total, unit) as bar:
            while _shown(plan) == (total, unit):
                look()
                plan, now = supervisor.plan, time.monotonic()
                if now - began < RIVALRY_S:
                    monitor.refuse_earlier_run()
                done = now - began if plan.poses is None else _played(plan, monitor)
                bar.update(min(done, total or done), _status(plan, monitor))
                ended = ended or now if supervisor.finished else None
                if plan.duration is not None and now - began > plan.duration:
                    return
                if ended is not None and now - ended > SETTLE_S:
                    return


def _shown(plan: Plan) -> tuple[float | None, str]:
    """What a bar shows the run's progress in: its end, and the unit."""
    if plan.poses is None:
        return plan.duration, "s"
    return None if plan.loops else plan.poses, "poses" if plan.player == "path_player" else "images"


def _played(plan: Plan, monitor: Monitored) -> float:
    """How far what is played has come, in poses or images."""
    text = monitor.node.reports.get(plan.player, {}).get("played", "")
    return float(text) if text.isdecimal() and len(text) < 12 else 0.0


def _status(plan: Plan, monitor: Monitored) -> str:
    """The images so far, their rate and their age, in words."""
    again = ""
    if plan.loops:
        when = "at its end" if plan.poses is None else f"every {plan.poses} {_shown(plan)[1]}"
        again = f"begins again {when}; "
    slicer = monitor.node.reports.get(IMAGER, {})
    count = monitor.node.count(IMAGER, IMAGES)
    if not count:
        heard = slicer.get("received", "0") != "0"
        poses = monitor.node.reports.get(plan.player, {}).get("awaited", "poses")
        return again + (
            "nobody subscribes to ultrasound/image" if heard else f"waiting for {poses}"
        )
    return (
        f"{again}{count} images, {slicer.get('rate_hz', '?')}/s, "
        f"p99 {slicer.get('latency_p99_ms', '?')} ms"
    )
